"""Checks of cameras, poses and points, which all layouts share, with medians and quantiles rather than means."""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sadgs_ns.data import colmap, ply
from sadgs_ns.data.checks.findings import Finding, and_more, fault, note, warning
from sadgs_ns.data.images import read_small
from sadgs_ns.data.level import LARGEST_TILT, tilt
from sadgs_ns.data.views import NO_COEFFICIENTS, Camera, View
from sadgs_ns.errors import InputError
from sadgs_ns.geometry.outliers import CAMERA_SHARE, FEWEST_PLACES, POINT_SHARE, REACH, far_outliers, has_enough_places

_FARTHEST = 2.0**23 / 1000  # Distance of a camera, in spreads of the others, which then have 1,000 float32 steps
_WIDEST = 170.0  # Angle of view in degrees under which lenses without fisheye stay
_NARROW = 0.5  # Angle in degrees above which lenses stay
_NARROWEST = 0.01  # Angle in degrees under which no pixel shows any depth
_FARTHEST_CENTER = 10  # Distance in image sizes at which a principal point is a mistake, and not due to a crop
_STRONGEST_DISTORTION = 2.0  # Quotient of distorted and undistorted radius from which OpenCV's undistortion diverges
_LEAST_FIT = 0.15  # Correlation of points' and photos' colours: 0.36 to 0.78 in eight captures, else mostly under 0.1
_LEAST_SPREAD = 4  # Standard deviation of colours in 0 … 255, under which they tell nothing


def check_views(views: Sequence[View], training: int, source: Path) -> Generator[Finding, None, bool]:
    """Check number, cameras, rotations and positions of a file's views; return whether none of them is an error."""
    findings: list[Finding] = []
    if len(views) < 2:
        findings.append(fault(f"{source} has 1 view, which shows no depth: take at least 2 images, better 20 or more."))
    elif training == 0:
        findings.append(fault(f"{source} leaves no view for training: hold out fewer images."))
    elif training < 3:
        few = "1 training view"
        if training > 1:
            few = f"{training} training views"
        findings.append(warning(f"{source} leaves {few}: so few fix no shape; take 20 or more."))
    wrong_rotations = list(check_rotations(views))
    findings += wrong_rotations
    if not wrong_rotations:
        findings += _check_tilt(views, source)
    findings += _check_centres(views, source)
    first = {view.camera: view.where_camera for view in reversed(views)}  # The first view with a camera names it.
    for camera, where in first.items():
        findings += _check_camera(camera, where)
    yield from findings
    return all(finding.severity != "error" for finding in findings)


def check_times(times: Sequence[Any], source: object) -> Iterator[Finding]:
    """Warn of views that a source gives different times, since training takes all as of one moment."""
    if len({str(time) for time in times}) > 1:
        problem = f"{source} gives each frame a time, as of a scene that moves, and all are trained as of one moment"
        yield warning(f"{problem}: what moves will blur, so keep the frames of one time if you can.")


def check_rotations(views: Sequence[View]) -> Iterator[Finding]:
    """Check that the views' rotations are neither skewed nor mirrored."""
    rotations = np.stack([view.rotation for view in views])  # [V, 3, 3]
    products = rotations @ rotations.transpose(0, 2, 1)  # [V, 3, 3]
    skewed = np.abs(products - np.eye(3)).max(axis=(1, 2)) > 0.01  # [V]
    mirrored = ~skewed & (np.linalg.det(rotations) < 0)
    if skewed.any():
        where = _first_of(views, skewed)
        problem = f"{where} has a pose whose rotation is stretched, skewed or 0"
        yield fault(f"{problem}: remove what scales its three columns, or compute the poses again.")
    if mirrored.any():
        where = _first_of(views, mirrored)
        problem = f"{where} has a mirrored pose (determinant −1)"
        yield fault(f"{problem}: negate one column of its rotation, or compute the poses again.")


def _check_tilt(views: Sequence[View], source: Path) -> Iterator[Finding]:
    """Warn of cameras that no one holds so, as of parts that are joined wrongly."""
    found = tilt(np.stack([view.rotation for view in views]))
    if found > LARGEST_TILT:
        problem = f"{source} has cameras that are tilted to all sides, by {found:.0f}° (root mean square)"
        cause = "as where parts are joined wrongly because two sides of a thing look alike, or photos lie on their side"
        yield warning(f"{problem}, {cause}: look at the poses in the viewer, and compute them again if parts overlap.")


def _first_of(views: Sequence[View], marked: NDArray[np.bool_]) -> str:
    """Return the start of a sentence on the marked views [V], at least one."""
    first = views[int(marked.argmax())]
    return and_more(first.where, int(marked.sum()))


def _check_centres(views: Sequence[View], source: Path) -> Iterator[Finding]:
    centres = np.stack([view.centre for view in views])  # [V, 3]
    largest_offset = np.abs(centres - centres.mean(axis=0)).max()
    rounding = 1e-9 * max(np.abs(centres).max(), 1.0)
    if len(centres) > 1 and largest_offset <= rounding:
        yield fault(f"{source} has all {len(centres)} cameras in one place, which shows no depth: move between images.")
        return
    _, distances, spread = _spread(centres)
    far = far_outliers(centres, CAMERA_SHARE)  # [V]
    if spread > 0 and far.any():
        where = _first_of(views, far)
        times = f"{distances.max() / spread:.3g} times as far from the other cameras as those are from each other"
        finding = warning
        if distances.max() > _FARTHEST * spread:
            finding = fault
        yield finding(f"{where} has its camera {times}: remove the image from the poses, or compute them again.")


def _check_camera(camera: Camera, where: str) -> Iterator[Finding]:
    yield from _check_principal_point(camera, where)
    yield from _check_focal_lengths(camera, where)
    yield from _check_distortion(camera, where)


def _check_principal_point(camera: Camera, where: str) -> Iterator[Finding]:
    off = max(abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5))  # Image sizes from the middle
    if off > 0.5:
        place = "outside"
    elif max(camera.cx, camera.cy) <= 1:  # These are shares of the image, or were not known.
        place = "in a corner of"
    else:
        return
    center = f"its principal point at ({camera.cx:g}, {camera.cy:g}) px"
    image = f"its image of {camera.width} × {camera.height} px"
    finding = warning
    if off > _FARTHEST_CENTER:
        finding = fault
    yield finding(f"{where} has {center}, {place} {image}: correct cx and cy, in pixels.")


def _check_focal_lengths(camera: Camera, where: str) -> Iterator[Finding]:
    angle = 2 * math.degrees(math.atan(max(_half_sizes(camera))))
    if not camera.fisheye and not _NARROW <= angle <= _WIDEST:
        size = f"{camera.width} × {camera.height} px"
        focal = f"the focal length {camera.fx:g} px, with which {size} span an angle of {angle:.2g}°"
        finding = fault
        if _NARROWEST <= angle <= _WIDEST:
            finding = warning
        yield finding(f"{where} has {focal}: correct it, in pixels.")
    if not 0.5 <= camera.fx / camera.fy <= 2:
        focals = f"the focal lengths {camera.fx:g} and {camera.fy:g} px, which differ as no lens's do"
        yield warning(f"{where} has {focals}: correct them, in pixels.")


def _check_distortion(camera: Camera, where: str) -> Iterator[Finding]:
    if any(abs(value) > 0.5 for value in camera.tangential):
        coefficients = ", ".join(f"{value:g}" for value in camera.tangential)
        yield fault(f"{where} has p1, p2 = {coefficients}, which no lens has: calibrate the camera again.")
    if not any(camera.radial):
        if camera.fisheye and camera.radial:
            yield fault(f"{where} is a fisheye {NO_COEFFICIENTS}")
        return
    coefficients = ", ".join(f"{value:g}" for value in camera.radial)
    problem = f"{where} has the radial distortion {coefficients}, which cannot be undone"
    half_width, half_height = _half_sizes(camera)
    if not _can_be_undone(camera, min(half_width, half_height)):
        yield fault(f"{problem}: calibrate the camera again, or undistort the images yourself.")
    elif not camera.fisheye and not _can_be_undone(camera, math.hypot(half_width, half_height)):
        yield warning(f"{problem} in the image's corners: they will be wrong; calibrate the camera again.")


def _half_sizes(camera: Camera) -> tuple[float, float]:
    """Return half an image's width and height, in focal lengths."""
    return camera.width / 2 / camera.fx, camera.height / 2 / camera.fy


def _can_be_undone(camera: Camera, radius: float) -> bool:
    """Return whether distortion can be undone up to a distorted radius, in focal lengths from the principal point.

    It can be undone if up to there the distorted radius rises with the undistorted one, so that no two directions share
    a pixel, and if, except for a fisheye, their quotient at this radius is at most `_STRONGEST_DISTORTION`.
    """
    largest = 4 * radius
    if camera.fisheye:
        largest = np.pi
    undistorted = np.linspace(0, largest, 2049)  # Radii, or angles of a fisheye
    with np.errstate(all="ignore"):  # Large coefficients overflow.
        factor = np.polyval([*reversed(camera.radial), 1.0], undistorted**2)
        distorted = undistorted * factor
        rises = np.diff(distorted) > 0
    end = len(rises)  # Up to here the distorted radius rises.
    if not rises.all():
        end = int(rises.argmin())
    if not distorted[end] >= radius:  # It may be NaN.
        return False
    is_reached = distorted[: end + 1] >= radius
    first_reached = int(is_reached.argmax())
    return bool(camera.fisheye or factor[first_reached] <= _STRONGEST_DISTORTION)


def check_ply(path: Path, views: Sequence[View], remedy: str) -> Iterator[Finding]:
    """Check a PLY file of SfM points as `check_points` does."""
    try:
        points = ply.read_points(path)
    except InputError as error:
        problem = str(error).removeprefix(f"{path} ").rpartition(": ")[0]
        yield fault(f"{path} should hold the SfM points but {problem}: {remedy}.")
        return
    yield from check_points(points, views, path, remedy)
    _, colors = points
    if len(colors) and (colors == ply.GREY).all():
        yield note(f"{path} has points without colours, which start grey.")


def check_points(points: colmap.Points, views: Sequence[View], path: Path, remedy: str) -> Iterator[Finding]:
    """Count SfM points, and check them against views and their images; `remedy` ends a sentence on broken ones."""
    positions, _ = points
    if not np.isfinite(positions).all():
        yield fault(f"{path} has NaN or infinity in a point: {remedy}.")
    elif len(positions) == 0:
        yield fault(f"{path} holds no SfM point: {remedy}.")
    else:
        yield note(f"{path} has {len(positions):,} points.")
        if not has_enough_places(positions):
            problem = (
                f"{path} has SfM points in fewer than {FEWEST_PLACES} places, which say too little about the scene"
            )
            yield warning(f"{problem}: training starts as without points; {remedy}.")
        if views:
            yield from _check_distances(positions, views, path)
            yield from _check_colors(points, views, path, remedy)


def _check_colors(points: colmap.Points, views: Sequence[View], path: Path, remedy: str) -> Iterator[Finding]:
    step = len(points[0]) // 10_000 + 1
    positions = points[0][::step]
    colors = points[1][::step]
    some_views = views[:: len(views) // 8 + 1]
    with ThreadPoolExecutor() as pool:  # Pillow decodes in threads.
        found = pool.map(lambda view: _fit(positions, colors, view), some_views)
        fits = [fit for fit in found if fit is not None]
    if len(fits) > 2 and np.median(fits) < _LEAST_FIT:
        problem = f"{path} has points whose colours are not those of the photos where the poses put them"
        cause = "as where points and poses differ in axes or units, or photos are exchanged"
        yield warning(f"{problem}, {cause}: check both, {remedy}.")


def _fit(positions: NDArray[np.float64], colors: NDArray[np.uint8], view: View) -> float | None:
    """Return the correlation of the colours of points [P, 3] with the image's where they are seen; None if unknown.

    Only the nearer half of the points counts, because the others may be hidden. The mean colours of each of 4 × 4 cells
    of the image are subtracted, because the sky is at the top in a wrong photo, too.
    """
    camera = view.camera
    if camera.fisheye or view.image is None:
        return None
    x, y, z = view.rotation @ (positions - view.centre).T  # [P] each
    with np.errstate(all="ignore"):
        bend = np.polyval([*reversed(camera.radial), 1.0], (x**2 + y**2) / z**2)
        pixels = np.stack([x * camera.fx, y * camera.fy], -1) * (bend / z)[:, None] + [camera.cx, camera.cy]
    places = pixels / [camera.width, camera.height]  # Shares of width and height. [P, 2]
    is_inside = (places >= 0).all(1) & (places < 1).all(1)
    seen = (z > 0) & (bend > 2 / 3) & is_inside  # Where `bend` is less, lenses fold the image back.
    if seen.sum() < 200:
        return None
    image = read_small(view.image)
    if image is None:
        return None
    seen[seen] = z[seen] <= np.median(z[seen])
    places = places[seen]  # [S, 2]
    columns, rows = (places * image.shape[1::-1]).astype(int).T
    cells = (places * 4).astype(int) @ [1, 4]  # [S]
    both = np.concatenate([colors[seen], image[rows, columns]], axis=1).astype(np.float64)  # [S, 6]
    for cell in np.unique(cells):
        both[cells == cell] -= both[cells == cell].mean(axis=0)
    of_points = both[:, :3]
    of_image = both[:, 3:]
    spread_of_points = of_points.std()
    spread_of_image = of_image.std()
    if not min(spread_of_points, spread_of_image) > _LEAST_SPREAD:
        return None
    return float((of_points * of_image).mean() / (spread_of_points * spread_of_image))


def _check_distances(positions: NDArray[np.float64], views: Sequence[View], path: Path) -> Iterator[Finding]:
    far = far_outliers(positions, POINT_SHARE)
    if far.any():
        outliers = f"{far.sum()} of {len(far)} points more than {REACH:g} times as far out as {POINT_SHARE:.0%} of them"
        yield note(f"{path} has {outliers}: training leaves them out.")
    positions = positions[~far]
    middle, _, spread = _spread(np.stack([view.centre for view in views]))
    distance = float(np.median(np.linalg.norm(positions - middle, axis=1)))
    remedy = "take points and poses of one reconstruction, in the same units and axes"
    if spread > 0 and distance > 1e3 * spread:
        problem = f"{path} has its points {distance / spread:.3g} times as far away as the cameras are apart"
        finding = warning
        if distance > 1e5 * spread:
            finding = fault
        yield finding(f"{problem}, so that all images see them from one direction: {remedy}.")
        return
    share = _share_of_views_with_points(positions, views)
    if share == 0:
        yield fault(f"{path} has points that no camera can see in front of it: {remedy}.")
    elif share < 0.5:
        yield warning(f"{path} has points that only {share:.0%} of the cameras can see in front of it: {remedy}.")


def _share_of_views_with_points(positions: NDArray[np.float64], views: Sequence[View]) -> float:
    """Return the share of the views that have any of the points [P, 3] on their image or within half an image of it."""
    positions = positions[:: len(positions) // 10_000 + 1]  # [P, 3]
    views = views[:: len(views) // 50 + 1]
    num_seeing = 0
    for view in views:
        x, y, z = view.rotation @ (positions - view.centre).T  # [P] each
        visible = z > 0
        if not view.camera.fisheye:
            # Distortion is ignored, since it moves points by less than half an image.
            camera = view.camera
            from_middle_x = x * camera.fx + (camera.cx - camera.width / 2) * z  # In px, times the depth
            from_middle_y = y * camera.fy + (camera.cy - camera.height / 2) * z
            visible &= np.abs(from_middle_x) < camera.width * z
            visible &= np.abs(from_middle_y) < camera.height * z
        if visible.any():
            num_seeing += 1
    return num_seeing / len(views)


def _spread(centres: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return the median of centres [V, 3], their distances from it [V], and the distance within which most lie."""
    middle = np.median(centres, axis=0)
    distances = np.linalg.norm(centres - middle, axis=1)
    spread = float(np.quantile(distances, CAMERA_SHARE, method="lower"))
    if not spread > 1e-9 * np.abs(middle).max():  # On a tripod, rounding alone moves the centres.
        spread = 0.0
    return middle, distances, spread
