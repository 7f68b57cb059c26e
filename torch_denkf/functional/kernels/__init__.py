"""Fast implementations of formulas: small systems written out, random bits, shards of an ensemble."""
