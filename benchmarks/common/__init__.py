"""Shares options, jobs, tables, recipes of filters, scores and pictures among the studies."""
