"""The stages from photos to a scene: features, matches, cameras with points, and undistortion, all by pycolmap.

Each stage goes on where an interrupted run left it. Only the process of `colmap_process.py` may import this module.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

import pycolmap

from sadgs_ns.errors import InputError
from sadgs_ns.events import progress, span
from sadgs_ns.placing.adjustment import adjust_robustly, is_firm, leave_out_unheld, refine, settle
from sadgs_ns.placing.agreement import most_agreed
from sadgs_ns.placing.features import LISTED, UNLISTED, extract, rename_images
from sadgs_ns.placing.intrinsics import few_parameters, free_all_parameters
from sadgs_ns.placing.joining import join_cameras, join_in_database, same_cameras
from sadgs_ns.placing.judgement import judge, measure
from sadgs_ns.placing.matching_ahead import AlikePartners, MatchingAhead, Partners, PlannedPartners
from sadgs_ns.placing.model_files import check_written
from sadgs_ns.placing.panoramas import rotations
from sadgs_ns.placing.photos import empty_folder, in_order
from sadgs_ns.placing.plan import Matching, Summary
from sadgs_ns.placing.scene_files import hold_out_panoramas, write_transforms
from sadgs_ns.placing.undistortion import Undistortion

if TYPE_CHECKING:
    import numpy as np
    import torch

SEED = 0  # Seed of COLMAP's random samples, so that equal photos give nearly equal cameras; its own is the clock
_TRIALS = 2000
"""Random samples after which COLMAP gives up on a pair of photos. Its own 10,000 take three times as long, for pairs
with hardly anything in common, and find no more matches in the others."""
_PAIRS = 50  # Pairs of photos that COLMAP matches, saves and reports at a time; it starts its threads for each batch
_ADJUSTMENT = {
    "ba_global_frames_ratio": 3.0, "ba_global_points_ratio": 3.0,
    "ba_local_function_tolerance": 1e-4, "ba_global_function_tolerance": 1e-5,
    "ba_local_max_refinements": 1, "ba_global_max_refinements": 2,
}  # fmt: skip
"""Growth of a model until all of it is adjusted again, the relative change of the cost at which an adjustment ends, and
how often it is repeated on other points. COLMAP's own are 1.1, 0, 2 and 5."""
_PLACING = {"ba_local_num_images": 2, "init_min_tri_angle": 8.0}
"""Photos that are adjusted after each that is placed, and the least angle in degrees between the first two. COLMAP's
own are 6 and 16; of 200 frames of a room it looked 10 s for two with 16 and then took two with 8."""
_RELAXED = {"init_max_forward_motion": 1.0, "init_min_tri_angle": 4.0, "abs_pose_min_num_inliers": 15}
"""Limits of a second attempt (COLMAP's own: .95, 16° and 30), which takes .9 to 1.5 times as long as a first."""
_ENOUGH, _MOST_STRETCH = 0.9, 0.1
"""Share of the photos, or of those that are added, that suffices at the first attempt, and the largest difference of
the two focal lengths: those of lenses and of resized photos differ less, those of models that went wrong more."""
_SEED_STEP = 1000  # Seeds of one placing lie this far apart, so that those of benchmarks, 0, 1, 2, …, share none
_DISAGREEMENT = "disagreement.txt"  # File in a model's folder that holds `Measures.disagreement`
FEW_FEATURES = 500  # Keypoints under which a photo counts as blurred or empty


def make_model(
    photos: Path, groups: Sequence[Sequence[str]], matching: Matching, max_size: int, model: Path, base: Path | None,
    rigs: Sequence[Sequence[str]], alike: Sequence[Sequence[str]] = (),
) -> Summary:  # fmt: skip
    """Make a model of photos, and from it the undistorted scene in the folder `undistorted` beside it.

    Raise InputError if no two photos could be related, or none could be added.

    Args:
        photos: The folder of the photos.
        groups: The photos' names, those of one camera together.
        matching: Any but "auto".
        max_size: Longest side of the undistorted photos in px; 0 keeps them as they are.
        model: The model's folder. Beside it lie `write_alpha`'s and `write_masks`' files, and what a stopped run left.
        base: An earlier model's folder, to which photos are added; these alone are undistorted, and its cameras stay.
        rigs: The names of the views of each panorama.
        alike: The names of photos whose groups differ in their folder alone, so that their cameras may be one.
    """
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    names = sorted(itertools.chain(*groups, *rigs))
    database = model.with_name("database.db")
    gpu, nerfstudio = begin_imports()
    known = set() if base is None else registered_photos(pycolmap.Reconstruction(base))
    with Undistortion(photos, model, max_size, known) as undistortion:
        if model.exists():
            undistortion.begin(pycolmap.Reconstruction(model))
        else:
            with MatchingAhead(gpu, partners_of(names, rigs, matching)) as ahead:
                with span("features"):
                    extract(photos, groups, database, rigs, ahead.add)
                match(names, database, matching, gpu.result(), rigs, ahead=ahead)
            with span("placing"):
                place_cameras(photos, names, database, model, base, alike, on_adjusted=undistortion.begin)
        made = pycolmap.Reconstruction(model)
        with span("scene's files"):
            without_lens = undistortion.write_model(made)
            write_transforms(without_lens, undistortion.folder, nerfstudio.result().colmap_to_json)
            if rigs:
                hold_out_panoramas(undistortion.folder / "transforms.json", rigs)
            summary = summarize_model(names, made, model, matching)
        undistortion.wait()
    return summary


def summarize_model(names: Sequence[str], made: pycolmap.Reconstruction, model: Path, matching: Matching) -> Summary:
    """Return the summary of the model in a folder, of which its attempts and their disagreement are read."""
    attempts = (model / "attempts.txt").read_text()
    disagreement_file = model / _DISAGREEMENT
    moved = math.nan
    if disagreement_file.exists():  # A run of an earlier version, which is resumed, has none.
        moved = float(disagreement_file.read_text())
    return summarize(names, made, model.with_name("database.db"), matching, attempts, moved)


@cache
def begin_imports() -> tuple[Future[torch.device | None], Future[ModuleType]]:
    """Begin to import torch and nerfstudio's writer of scenes in a thread, because that takes seconds."""
    pool = ThreadPoolExecutor(1)
    return pool.submit(wake_gpu), pool.submit(_import_writer)


def _import_writer() -> ModuleType:
    """Import nerfstudio's writer of scenes."""
    with span("import of nerfstudio"):
        return import_module("nerfstudio.process_data.colmap_utils")


def wake_gpu() -> torch.device | None:
    """Import torch, and return the CUDA device if there is one, ready to compute."""
    with span("import of torch"):
        import torch

        import_module("sadgs_ns.placing.matching")  # `match` uses it, beside the import of nerfstudio in this thread.
    if not torch.cuda.is_available():
        return None
    device = torch.device("cuda")
    with span("start of CUDA"):  # The first operations on a device start it.
        torch.zeros(2, 2, device=device).mm(torch.zeros(2, 2, device=device))
    return device


def choose_pairs(names: Sequence[str], rigs: Sequence[Sequence[str]], matching: Matching) -> list[tuple[str, str]]:
    """Pair all photos, or with "sequential" each with some that follow it.

    The views of a panorama, which have one centre, are not paired with each other. With "sequential" only those views
    of two panoramas are paired that look the same way, and fewer follow, because a panorama overlaps with many.
    """
    in_turn = matching == "sequential"
    units = {views[0]: views for views in rigs}
    first = {view: views[0] for views in rigs for view in views}
    axes = rotations()[:, :, 2]
    order = list(dict.fromkeys(first.get(name, name) for name in (in_order(names) if in_turn else names)))
    pairs: list[tuple[str, str]] = []
    for a, b in sequential_pairs(order, 2 if rigs else 10) if in_turn else itertools.combinations(order, 2):
        views = itertools.product(units.get(a, [a]), units.get(b, [b]))
        both = in_turn and a in units and b in units
        pairs += itertools.compress(views, (axes @ axes.T > 0.4).flat) if both else views
    return pairs


def partners_of(names: Sequence[str], rigs: Sequence[Sequence[str]], matching: Matching) -> Partners:
    """Return what finds the photos that each is matched with while features of others are still being found."""
    if matching == "similar":
        return AlikePartners(rigs)
    return PlannedPartners(choose_pairs(names, rigs, matching))


def sequential_pairs(names: Sequence[str], overlap: int = 10) -> list[tuple[str, str]]:
    """Pair each frame with the next `overlap` ones, and with ever fewer of the later ones, which close loops."""
    steps = sorted({*range(1, overlap + 1), *(2**k for k in range(4, 10))})
    return [(names[i], names[i + step]) for i in range(len(names)) for step in steps if i + step < len(names)]


def match(
    names: Sequence[str], database: Path, matching: Matching, gpu: torch.device | None,
    rigs: Sequence[Sequence[str]] = (), seed: int = SEED, ahead: MatchingAhead | None = None,
) -> None:  # fmt: skip
    """Match the features in COLMAP's database between photos; pairs that an earlier run matched are skipped.

    A GPU compares the features while threads verify the matches; without one COLMAP does both, by lists in `pairs.txt`.
    The result is the same with matches that were found `ahead`.
    """
    from sadgs_ns.placing.matching import similar_photos, write_matches  # It imports torch; `wake_gpu` did.

    stage = f"matches ({matching})"
    pair_list = database.with_name("pairs.txt")
    verification = verification_options(seed)
    progress(stage, 0, 1)
    matched: dict[tuple[int, int], np.ndarray] = {}
    on_device: Mapping[int, torch.Tensor] = {}
    largest: Mapping[int, torch.Tensor] = {}
    if ahead is not None:
        ahead.stop()
        matched = ahead.matches
        on_device = ahead.descriptors
        largest = ahead.largest
    with span("choice of pairs"):
        if matching == "similar":
            panorama = {view: views[0] for views in rigs for view in views}
            alike = similar_photos(database, gpu, largest)
            pairs = [(a, b) for a, b in alike if panorama.get(a, a) != panorama.get(b, b)]
        else:
            pairs = choose_pairs(names, rigs, matching)
    if gpu is not None:
        with span("matches"):
            write_matches(database, pairs, gpu, stage, verification, matched, on_device)
    else:
        with span("matches"):
            rename_images(database, LISTED)  # In a list of pairs COLMAP takes # for a comment, and spaces to end names.
            for start in range(0, len(pairs), _PAIRS):
                progress(stage, start, len(pairs))
                listed = ((a.translate(LISTED), b.translate(LISTED)) for a, b in pairs[start : start + _PAIRS])
                pair_list.write_text("".join(f"{a} {b}\n" for a, b in listed), "utf8")
                pairing = pycolmap.ImportedPairingOptions(match_list_path=pair_list)
                pycolmap.match_image_pairs(database, pairing_options=pairing, verification_options=verification)
            rename_images(database, UNLISTED)
    progress(stage, len(pairs), len(pairs))


def verification_options(seed: int) -> pycolmap.TwoViewGeometryOptions:
    """Return COLMAP's options for the verification of matches with a seed."""
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    options.ransac.max_num_trials = _TRIALS
    return options


def place_cameras(
    photos: Path, names: Sequence[str], database: Path, model: Path, base: Path | None,
    alike: Sequence[Sequence[str]] = (), seed: int = SEED,
    on_adjusted: Callable[[pycolmap.Reconstruction], None] | None = None,
) -> None:  # fmt: skip
    """Estimate cameras and points, and write the best model; its folder appears when it is complete.

    Photos are added to an earlier model: its poses and intrinsics stay as they are, points are triangulated with the
    new photos, and photos that did not register before are tried again. Cameras of photos that are `alike`, as of
    `make_model`, are joined if they are one and the model suffices. A new model that few points hold together is made
    again with other samples, as of `most_agreed`. `on_adjusted` is called with the model when only its colours are
    missing. Raise InputError if no photos could be related.
    """
    search = _Search.of(photos, names, database, model, base, seed)
    limits: Mapping[str, float] = {}
    best = search.attempt("cameras", limits)
    attempts = ""
    quality = search.quality(best)
    if not quality.suffices:
        second = search.attempt("cameras (relaxed)", _RELAXED)
        second_quality = search.quality(second)
        attempts = (
            f"A first attempt registered {quality.registered}, one with relaxed limits {second_quality.registered}."
        )
        if second_quality > quality:
            best = second
            quality = second_quality
            limits = _RELAXED
    before = search.before
    if before is None and best is None:
        raise InputError(_unrelated(names, database))
    if best is None or (before is not None and best.num_reg_images() <= before.num_reg_images()):
        raise InputError(
            "none of the photos that were added could be related to the others: give another output folder, for which "
            "all photos are placed together; take some that share two thirds of what they show with each other and "
            "with those that are there; or take these out of the folder again."
        )
    moved = math.nan
    if before is None and not is_firm(best):
        best, moved = most_agreed(best, lambda number: search.place_again(number, limits), search.rank)
        quality = search.quality(best)
    joined: dict[int, int] = {}
    if quality.suffices:
        joined = same_cameras(best, alike, search.fixed_cameras)
    if joined:
        best = join_cameras(best, joined)
        adjust_robustly(best, search.fixed_cameras, search.held_frames)
    for frame_id in search.held_frames:  # COLMAP rounds poses that it holds fixed.
        assert before is not None
        best.frames[frame_id].rig_from_world = before.frames[frame_id].rig_from_world
    if on_adjusted is not None:
        on_adjusted(best)
    partial = empty_folder(model.with_name("model.partial"))
    with span("colours and model"):
        best.extract_colors_for_all_images(photos)  # Otherwise a point has one photo's colour, or none.
        best.write(partial)
        check_written(partial, best)
    (partial / "attempts.txt").write_text(attempts)
    (partial / _DISAGREEMENT).write_text(str(moved))
    if joined:  # Photos that are added later find their folder's camera in the database.
        join_in_database(database, joined)
    partial.rename(model)
    progress("cameras", search.total, search.total)


class _Quality(NamedTuple):
    """Compares models: one that is not wrong first, then one that suffices, then the one with more photos."""

    is_possible: bool  # Whether nothing says that it is wrong
    suffices: bool  # Whether no other attempt is needed
    registered: int


@dataclass(frozen=True)
class _Search:
    """What the attempts to place the cameras of some photos share."""

    photos: Path  # The photos' folder
    names: Sequence[str]
    database: Path
    models: Path  # Folder of COLMAP's models, which is made anew by each attempt
    base: Path | None  # Folder of the model to which photos are added
    before: pycolmap.Reconstruction | None  # That model
    total: int  # Number of frames, each a photo or a panorama
    fixed_cameras: set[int]  # Cameras whose intrinsics stay
    seed: int

    @classmethod
    def of(
        cls, photos: Path, names: Sequence[str], database: Path, model: Path, base: Path | None, seed: int
    ) -> _Search:
        with pycolmap.Database.open(database) as opened:
            total = opened.num_frames()
            rigs = [rig for rig in opened.read_all_rigs() if rig.num_sensors() > 1]
        fixed = {sensor.id for rig in rigs for sensor in rig.sensor_ids()}  # Panoramas are cut for these cameras.
        before = None
        if base is not None:
            before = pycolmap.Reconstruction(base)
            fixed |= set(before.cameras)
        return cls(photos, names, database, model.with_name("models"), base, before, total, fixed, seed)

    @property
    def held_frames(self) -> list[int]:
        """Frames of the earlier model, whose poses stay."""
        if self.before is None:
            return []
        return [frame_id for frame_id, frame in self.before.frames.items() if frame.has_pose]

    def options(self, limits: Mapping[str, float]) -> pycolmap.IncrementalPipelineOptions:
        """Return COLMAP's options for an attempt with some limits of its mapper."""
        chosen: dict[str, Any] = {"min_model_size": 3}
        if self.before is not None:
            chosen = {"multiple_models": False, "fix_existing_frames": True, "image_names": list(self.names)}
        chosen |= {"constant_cameras": self.fixed_cameras, "ba_refine_sensor_from_rig": False}
        options = pycolmap.IncrementalPipelineOptions(
            random_seed=self.seed, extract_colors=False, **_ADJUSTMENT, **chosen
        )
        # Points that hold no photo wait for the last adjustment.
        skips_points = not self.fixed_cameras
        options.mapper.mergedict({**_PLACING, "ba_global_ignore_redundant_points3D": skips_points, **limits})
        return options

    def attempt(self, stage: str, limits: Mapping[str, float]) -> pycolmap.Reconstruction | None:
        """Place the cameras with some limits, and return the best model, or None without any."""
        registered = 0
        if self.before is not None:
            registered = self.before.num_reg_frames()

        def advance(more: int) -> None:
            nonlocal registered
            registered = min(registered + more, self.total)  # COLMAP goes on counting when it begins another model.
            progress(stage, registered, self.total)

        advance(0)
        options = self.options(limits)
        if self.before is None:
            simplification = few_parameters(self.database, self.fixed_cameras)
        else:
            simplification = contextlib.nullcontext()  # The earlier model's cameras have all parameters.
        with simplification:
            models = pycolmap.incremental_mapping(
                self.database,
                self.photos,
                empty_folder(self.models),
                options,
                input_path=self.base or "",
                initial_image_pair_callback=lambda: advance(2),
                next_image_callback=lambda: advance(1),
            )
        candidates = [model for model in models.values() if model.num_points3D() > 0]
        best = max(candidates, key=self.quality, default=None)
        if best is None:
            return None
        if self.before is None:
            free_all_parameters(best)
            refine(best, self.database, options)
            if best.num_points3D() > 0 and not is_firm(best):
                settle(best, self.database, options, self.fixed_cameras)
        adjust_robustly(best, self.fixed_cameras, self.held_frames)
        leave_out_unheld(best, self.held_frames)
        if best.num_points3D() == 0:  # None fits with all parameters.
            return None
        return best

    def place_again(self, number: int, limits: Mapping[str, float]) -> pycolmap.Reconstruction | None:
        """Verify the matches and place the cameras with another seed, and return the best model if there is one.

        The samples of the verification decide more than the mapper's: of lund, mappings of the same verified matches
        with three of four seeds gave one model.
        """
        database = self.database.with_name("again.db")
        shutil.copyfile(self.database, database)
        seed = self.seed + number * _SEED_STEP
        with pycolmap.Database.open(database) as opened:
            opened.clear_two_view_geometries()
        pycolmap.geometric_verification(database, two_view_geometry_options=verification_options(seed))
        model = replace(self, database=database, seed=seed).attempt("cameras (checked)", limits)
        database.unlink()
        return model

    def rank(self, model: pycolmap.Reconstruction) -> tuple[bool, int]:
        """Return whether a model can be right, and how many photos it registered."""
        quality = self.quality(model)
        return quality.is_possible, quality.registered

    def quality(self, candidate: pycolmap.Reconstruction | None) -> _Quality:
        """Tell whether a model can be right, whether it suffices, and how many photos it registered.

        Where photos are added, those of the earlier model do not count for whether it suffices: they would hide that
        none was added to many.
        """
        if candidate is None:
            return _Quality(False, False, 0)
        count = candidate.num_reg_images()
        num_before = 0
        if self.before is not None:
            num_before = self.before.num_reg_images()
        measures = measure(candidate)
        num_expected = len(self.names) - num_before
        is_enough = count - num_before >= _ENOUGH * num_expected and measures.stretch < 1 + _MOST_STRETCH
        judgement = judge(measures)
        return _Quality(not judgement.faults, is_enough and judgement.is_sound, count)


def _unrelated(names: Sequence[str], database: Path) -> str:
    """Return the sentence for photos of which no two could be related."""
    with pycolmap.Database.open(database) as opened:
        images = opened.read_all_images()
        poor = sum(opened.num_keypoints_for_image(image.image_id) < FEW_FEATURES for image in images)
    return (
        f"no two photos could be related to each other ({poor} of {len(names)} have fewer than {FEW_FEATURES} "
        "features); take more of them, from different places, with at least two thirds of overlap, sharp, and of a "
        "scene with texture."
    )


def registered_photos(model: pycolmap.Reconstruction) -> set[str]:
    """Return the names of the photos with a pose in a model."""
    return {image.name for image in model.images.values() if image.has_pose}


def summarize(
    names: Sequence[str],
    model: pycolmap.Reconstruction,
    database: Path,
    matching: Matching,
    attempts: str,
    moved: float = math.nan,
) -> Summary:
    """Count the registered photos, find out why the others are none, and judge the model.

    `moved` is the disagreement with another placing, as of `Measures`.
    """
    registered = registered_photos(model)
    left_out = {}
    with pycolmap.Database.open(database) as opened:
        identities = {image.name: image.image_id for image in opened.read_all_images()}
        pair_ids, inliers = opened.read_two_view_geometry_num_inliers()
        matches = dict.fromkeys(identities.values(), 0)
        placed = {identities[name] for name in registered if name in identities}
        related = set[int]()  # Photos that share matches with a registered one
        for pair, count in zip(pair_ids, inliers, strict=True):
            both = pycolmap.pair_id_to_image_pair(pair)
            for identity in both:
                matches[identity] = max(matches[identity], count)
            if count > 0 and not placed.isdisjoint(both):
                related.update(both)
        for name in set(names) - registered:
            identity = identities.get(name)
            if identity is None:
                left_out[name] = "could not be read"
                continue
            count = opened.num_keypoints_for_image(identity)
            if count < FEW_FEATURES:
                left_out[name] = f"only {count} features: blurred, dark or without texture"
            elif matches[identity] < 30:
                left_out[name] = "matches no other photo: too little overlap"
            elif identity not in related:
                left_out[name] = "matches none of the registered photos, only others that are left out: another scene?"
            else:
                left_out[name] = "matches other photos, but its pose stayed ambiguous"
    error = model.compute_mean_reprojection_error()
    judgement = judge(replace(measure(model), disagreement=moved))
    return Summary(
        len(names), len(registered), model.num_points3D(), error, left_out, matching, attempts, judgement.doubts,
        judgement.faults,
    )  # fmt: skip
