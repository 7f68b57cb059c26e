"""Formulas of smoothers."""
