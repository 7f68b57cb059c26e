"""Several sensors in one filter: each dropped, disturbed or delayed in turn."""
