"""Times filters on a GPU at each batch size."""
