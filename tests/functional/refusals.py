"""What the library refuses, one line each."""

import pytest


def assert_refused(error, words, call, /, *args, **kwargs):
    """``call(*args, **kwargs)`` raises ``error``, and its message holds ``words``, a regular expression."""
    with pytest.raises(error, match=words):
        call(*args, **kwargs)
