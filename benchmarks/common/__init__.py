"""Options, jobs, tables, recipes of filters, scores and plots that the studies share."""
