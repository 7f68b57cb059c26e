"""How many members does an ensemble need?"""
