"""Parts of examples/ur5_manipulation.py: what is collected, built, trained, measured."""
