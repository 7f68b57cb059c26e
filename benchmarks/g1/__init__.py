"""Study: a real arm that its head camera watches."""
