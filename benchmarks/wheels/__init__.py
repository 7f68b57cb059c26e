"""How many members does an ensemble with fast sensors need?"""
