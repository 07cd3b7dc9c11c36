"""Input that the package refuses."""

from __future__ import annotations

import pytest

from sadgs_ns.errors import InputError


def refusal(sentence: str) -> pytest.RaisesExc[InputError]:
    """Expect that a block refuses its input in one sentence, which a regular expression describes."""
    return pytest.raises(InputError, match=sentence)
