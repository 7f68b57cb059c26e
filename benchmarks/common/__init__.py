"""What the studies have in common: options, jobs, tables, recipes of filters, scores, pictures."""
