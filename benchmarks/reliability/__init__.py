"""Tests every interface of the library with damaged inputs, and in long runs."""
