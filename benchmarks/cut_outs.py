"""Things that stand in the way: cut out of photos along outlines that are given here, or drawn.

The photos are the user's, of a toy and of a computer mouse; the repository holds nothing of them. Figures need no file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

BAND = 6
"""Half the width, in px, of the band around an outline in which GrabCut finds the edge."""
MARGIN = 30
"""Pixels around an outline that GrabCut sees, to learn the colours of what lies behind."""
ROUNDS = 3
"""Iterations of GrabCut."""
FIGURE_SIZE = 800
"""Height of a drawn person and width of a drawn car, in px; they are only made smaller, as a rule."""

Pixels = NDArray[np.uint8]


@dataclass(frozen=True)
class Outline:
    """Where a thing lies in a photo."""

    photo: str
    """Path of the photo below the folder of all photos."""
    corners: tuple[tuple[int, int], ...]
    """Of a polygon around the thing, as x and y in px."""


# fmt: off
OUTLINES = (
    Outline("plush/0007.jpg", (
        (445, 85), (454, 66), (480, 59), (502, 70), (507, 96), (550, 77), (602, 67), (661, 71), (705, 92), (722, 100),
        (735, 88), (772, 79), (805, 103), (809, 137), (785, 170), (772, 174), (790, 233), (789, 277), (809, 366),
        (844, 440), (840, 477), (816, 490), (794, 480), (798, 528), (779, 573), (735, 587), (691, 565), (674, 528),
        (624, 528), (554, 514), (528, 540), (476, 549), (432, 532), (418, 491), (435, 458), (487, 440), (472, 375),
        (435, 421), (406, 429), (395, 403), (413, 351), (443, 318), (421, 292), (417, 259), (439, 242), (443, 181),
        (461, 137), (450, 122),
    )),
    Outline("plush/0025.jpg", (
        (584, 62), (588, 35), (601, 29), (612, 39), (611, 61), (646, 59), (681, 70), (708, 101), (747, 179), (774, 241),
        (802, 284), (829, 352), (856, 354), (875, 382), (868, 409), (837, 414), (833, 452), (802, 490), (755, 522),
        (685, 545), (654, 564), (591, 585), (556, 572), (543, 537), (543, 498), (564, 459), (525, 436), (510, 397),
        (517, 358), (514, 340), (482, 343), (463, 323), (436, 284), (424, 249), (436, 231), (471, 214), (471, 171),
        (486, 132), (521, 86), (556, 66),
    )),
    Outline("mouse/2047F18D8DCF99F529058668EBCA5905.jpg", (
        (681, 418), (725, 414), (794, 427), (853, 464), (897, 523), (926, 596), (939, 705), (943, 803), (941, 862),
        (931, 930), (922, 999), (872, 1038), (804, 1056), (696, 1058), (597, 1034), (509, 999), (472, 960), (470, 891),
        (484, 803), (509, 685), (521, 557), (548, 503), (578, 464), (627, 431),
    )),
    Outline("mouse/A894D0C1DC6649F9D1B34BEDF6597C6D.jpg", (
        (491, 725), (505, 697), (589, 655), (659, 606), (743, 578), (841, 543), (953, 525), (1093, 529), (1205, 557),
        (1303, 599), (1387, 662), (1457, 746), (1488, 817), (1485, 866), (1443, 893), (1331, 922), (1275, 931),
        (1065, 926), (855, 943), (659, 951), (589, 887), (540, 847), (502, 803),
    )),
)
# fmt: on
"""The things that are cut out of photos."""


@dataclass(frozen=True)
class CutOut:
    """A thing without what is around it."""

    name: str
    pixels: Pixels
    """Colours and opacity, which is 0 or 255. [H, W, 4]"""

    @property
    def area(self) -> int:
        """Number of its pixels."""
        return int(np.count_nonzero(self.pixels[..., 3]))


def cut_out(photos: Path, outline: Outline) -> CutOut:
    """Cut a thing out of a photo below a folder of photos; GrabCut moves its outline to the edge nearby.

    Raises ValueError if the photo cannot be read or is smaller than the outline.
    """
    path = photos / outline.photo
    try:
        with Image.open(path) as image:
            photo = np.asarray(image.convert("RGB"))
    except OSError as error:
        remedy = "give the folder that holds plush and mouse as --photos, or leave --photos out"
        raise ValueError(f"{path} cannot be read; {remedy}.") from error
    corners = np.array(outline.corners, np.int32)
    left, top = np.maximum(corners.min(axis=0) - MARGIN, 0)
    right, bottom = corners.max(axis=0) + 1
    if right > photo.shape[1] or bottom > photo.shape[0]:
        raise ValueError(f"{path} is smaller than the outline of what is cut out; give the original as --photos.")
    part = np.ascontiguousarray(photo[top : bottom + MARGIN, left : right + MARGIN])
    inside = np.zeros(part.shape[:2], np.uint8)
    cv2.fillPoly(inside, [corners - np.array([left, top], np.int32)], (1,))
    thing = _largest_part(_move_to_edges(part, inside))
    return CutOut(outline.photo, _cropped(np.dstack([part, 255 * thing]).astype(np.uint8)))


def _move_to_edges(part: Pixels, inside: Pixels) -> Pixels:
    """Return which pixels of a part of a photo [H, W, 3] are the thing's, 1 or 0, given those in its outline. [H, W]"""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * BAND + 1, 2 * BAND + 1))
    labels = np.full(inside.shape, cv2.GC_BGD, np.uint8)
    labels[cv2.dilate(inside, disc) > 0] = cv2.GC_PR_BGD
    labels[inside > 0] = cv2.GC_PR_FGD
    labels[cv2.erode(inside, disc) > 0] = cv2.GC_FGD
    cv2.setRNGSeed(0)
    # GrabCut writes its models of the colours to these, and reads no rectangle as there are labels.
    background = np.zeros((1, 65))
    foreground = np.zeros((1, 65))
    cv2.grabCut(part, labels, (0, 0, 0, 0), background, foreground, ROUNDS, cv2.GC_INIT_WITH_MASK)
    return np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.uint8)


def _largest_part(mask: Pixels) -> Pixels:
    """Return the largest connected part of a mask of 1 and 0. [H, W]"""
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    largest = 1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA]))
    return (labels == largest).astype(np.uint8)


def _cropped(pixels: Pixels) -> Pixels:
    """Return the smallest rectangle of colours and opacity that holds all that can be seen. [H, W, 4]"""
    rows = np.flatnonzero(pixels[..., 3].any(axis=1))
    columns = np.flatnonzero(pixels[..., 3].any(axis=0))
    return pixels[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]


def draw_person(shirt: str, trousers: str) -> CutOut:
    """Draw somebody who walks, in a striped shirt and trousers of these colours."""
    height = FIGURE_SIZE
    image = Image.new("RGBA", (height // 2, height))
    draw = ImageDraw.Draw(image)

    def across(*places: float) -> list[tuple[float, float]]:
        """Points in px, of x and y in heights of the person."""
        return [(x * height, y * height) for x, y in zip(places[::2], places[1::2], strict=True)]

    skin = "#c99672"
    draw.polygon(across(0.16, 0.50, 0.27, 0.50, 0.17, 0.95, 0.08, 0.93), trousers)
    draw.polygon(across(0.22, 0.50, 0.34, 0.50, 0.42, 0.92, 0.33, 0.95), trousers)
    draw.polygon(across(0.07, 0.93, 0.17, 0.94, 0.19, 0.98, 0.05, 0.98), "#3a2a20")
    draw.polygon(across(0.33, 0.94, 0.42, 0.91, 0.47, 0.96, 0.34, 0.98), "#3a2a20")
    draw.polygon(across(0.16, 0.20, 0.20, 0.26, 0.12, 0.52, 0.06, 0.50), skin)
    draw.polygon(across(0.34, 0.20, 0.30, 0.26, 0.40, 0.50, 0.45, 0.48), skin)
    draw.polygon(across(0.17, 0.17, 0.33, 0.17, 0.36, 0.30, 0.34, 0.52, 0.16, 0.52, 0.14, 0.30), shirt)
    for i in range(6):
        y = 0.20 + 0.05 * i
        draw.rectangle(across(0.17, y, 0.33, y + 0.02), "#f2efe6")
    draw.rectangle(across(0.22, 0.12, 0.28, 0.18), skin)
    draw.ellipse(across(0.18, 0.01, 0.32, 0.15), skin)
    draw.chord(across(0.17, 0.0, 0.33, 0.15), 160, 380, "#2b1d14")
    draw.ellipse(across(0.215, 0.075, 0.23, 0.09), "#202020")
    draw.ellipse(across(0.27, 0.075, 0.285, 0.09), "#202020")
    return CutOut(f"a person in {shirt}", _cropped(_grained(np.asarray(image))))


def draw_car(paint: str) -> CutOut:
    """Draw a car of this colour from its side."""
    width = FIGURE_SIZE
    image = Image.new("RGBA", (width, width // 2))
    draw = ImageDraw.Draw(image)

    def across(*places: float) -> list[tuple[float, float]]:
        """Points in px, of x and y in widths of the car."""
        return [(x * width, y * width) for x, y in zip(places[::2], places[1::2], strict=True)]

    draw.polygon(
        across(0.02, 0.22, 0.20, 0.19, 0.30, 0.06, 0.66, 0.06, 0.80, 0.20, 0.98, 0.24, 0.98, 0.36, 0.02, 0.36), paint
    )
    draw.polygon(across(0.24, 0.19, 0.32, 0.08, 0.46, 0.08, 0.46, 0.19), "#9db4c0")
    draw.polygon(across(0.49, 0.08, 0.64, 0.08, 0.75, 0.19, 0.49, 0.19), "#9db4c0")
    draw.line(across(0.475, 0.07, 0.475, 0.35), "#202020", 4)
    draw.rectangle(across(0.51, 0.225, 0.57, 0.24), "#202020")
    draw.rectangle(across(0.94, 0.25, 0.98, 0.28), "#ffe9a0")
    draw.rectangle(across(0.02, 0.24, 0.05, 0.28), "#c01818")
    for x in (0.21, 0.79):
        draw.ellipse(across(x - 0.09, 0.27, x + 0.09, 0.45), "#181818")
        draw.ellipse(across(x - 0.05, 0.31, x + 0.05, 0.41), "#b8b8b8")
        draw.line(across(x - 0.05, 0.36, x + 0.05, 0.36), "#505050", 6)
        draw.line(across(x, 0.31, x, 0.41), "#505050", 6)
    return CutOut(f"a car in {paint}", _cropped(_grained(np.asarray(image))))


def _grained(pixels: Pixels) -> Pixels:
    """Return a drawing [H, W, 4] with a grain and a shade from left to right, as flat colours are rare in photos."""
    height, width = pixels.shape[:2]
    grain = np.random.default_rng(0).integers(-12, 13, (height, width, 1))
    shade = np.linspace(-25, 25, width).round().astype(np.int64)[None, :, None]
    result = pixels.copy()
    result[..., :3] = (pixels[..., :3] + grain + shade).clip(0, 255)
    return result


def all_cut_outs(photos: Path | None) -> Sequence[CutOut]:
    """Return the drawn figures and, if there is a folder of photos, what is cut out of them; raises as `cut_out`."""
    figures = [
        draw_person("#b03030", "#28324a"),
        draw_person("#2f6f4f", "#6b6258"),
        draw_car("#2d5fa8"),
        draw_car("#d8d4c8"),
    ]
    if photos is not None:
        figures += [cut_out(photos, outline) for outline in OUTLINES]
    return figures
