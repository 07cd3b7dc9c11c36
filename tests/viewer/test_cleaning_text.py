"""Cleaning: what users are told, and which options are refused."""

from __future__ import annotations

import math

import pytest
import torch

from helpers.refusals import refusal
from sadgs_ns.geometry.cleaning import Cleaning, Remaining
from sadgs_ns.viewer.cleaning_text import check_options, removal_sentences

NOTHING = torch.ones(0, dtype=torch.bool)


@pytest.mark.parametrize(
    ("cleaning", "num_removed", "told"),
    [
        (Cleaning(), {}, []),
        (Cleaning(crop=(-1, -1, -1, 1, 1, 1)), {"crop": 2}, ["2 Gaussians outside the box are taken away."]),
        (Cleaning(max_extent=1.0), {"max_extent": 1200}, ["1,200 Gaussians longer than 1 are taken away."]),
        (
            Cleaning(min_views=3),
            {"min_views": 0},
            ["0 Gaussians seen by fewer than 3 of 5 training views are taken away."],
        ),
        (
            Cleaning(max_extent=1.0, dust=0.5),
            {"max_extent": 2, "dust": 1},
            [
                "2 Gaussians longer than 1 are taken away.",
                "1 Gaussian of less than 0.5 px in every training view is taken away.",
            ],
        ),
    ],
)
def test_a_sentence_says_what_each_option_takes(cleaning: Cleaning, num_removed: dict[str, int], told: list[str]):
    actual = removal_sentences(cleaning, Remaining(NOTHING, num_removed, num_views=5))
    assert actual == told


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"min_views": -1}, r"^--min-views -1 must be 0"),
        ({"dust": math.inf}, r"^--dust inf must be 0"),
        ({"max_extent": math.nan}, r"^--max-extent nan must be more than 0"),
        ({"crop": (0, 0, 0, 1, 0, 1)}, r"^--crop 0 0 0 1 0 1 is no box"),
        ({"crop": (0, 0, 0, 1, 1, math.inf)}, r"^--crop 0 0 0 1 1 inf is no box"),
    ],
)
def test_what_cannot_be_meant_is_refused(options: dict, message: str):
    with refusal(message):
        check_options(Cleaning(**options))
