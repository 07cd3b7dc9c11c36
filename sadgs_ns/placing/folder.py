"""Finds the photos or videos of a folder, and masks, and tells of other images."""

from __future__ import annotations

import contextlib
import filecmp
import math
import os
import re
from collections import defaultdict
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageOps

from sadgs_ns.data.images import (
    IMAGE_SUFFIXES,
    UNREAD_SUFFIXES,
    UNREADABLE,
    UNSTITCHED_SUFFIXES,
    VIDEO_SUFFIXES,
    image_size,
)
from sadgs_ns.data.layouts import automatic_options
from sadgs_ns.data.transforms import frames_of, mended_name, read_json
from sadgs_ns.errors import InputError
from sadgs_ns.files import read_settings
from sadgs_ns.placing.bands import other_bands
from sadgs_ns.placing.video import is_archive

COLMAP_FORMATS = {"JPEG", "MPO", "PNG", "BMP", "TIFF"}  # Pillow's names of the formats that COLMAP and OpenCV read
_FORMATS = COLMAP_FORMATS | {"WEBP", "AVIF", "HEIF"}
_LONGEST_NAME = 255 - len(".jpg.png")  # Bytes of a name to which a conversion and its mask add these suffixes
_UNSTITCHED = "files of 360° cameras (stitch them to panoramas or films of 2:1 with the camera's program)"
_NOT_READ = "images that are not read (make them .jpg or .png files)"
_SERVICE = re.compile(r"(.*/)?(@eadir|@__thumb|[@#$]recycle(\.bin)?|__macosx|lost\+found)/.*", re.IGNORECASE)
"""Files in folders of network drives and operating systems for thumbnails and deleted files."""
_MAP = re.compile(r"(.*/)?(depths?|normals|confidence)(_?maps?)?/.*|.*[ ._-](depth|confidence)\.\w+", re.IGNORECASE)
_MASK = re.compile(r"(.*/)?masks?(_\d+)?/.*|.*[ ._-]mask\.\w+", re.IGNORECASE)
_GREY_SPREAD = 16  # Between the channels of a grey pixel, in steps of a byte; JPEG stores grey with small errors.
_VARIANT = re.compile(r"(?<=^img_)e(?=\d)|[ ._-]*(mask|edited|copy|thumb|small)$")
"""Additions to a photo's name for its mask or a copy (IMG_E1 is the edited IMG_1), not the (1), (2) of Windows."""


def find_source(source: Path, out: Path) -> tuple[list[str], bool, dict[str, str], list[str]]:
    """Return the photos of a folder for a scene, or its videos if it has fewer than three photos.

    The result is their names (none for a single video), whether they are videos, and masks and sentences as of
    `look_into`. Raise InputError if there are neither three photos nor a video, or a name is no Unicode.
    """
    if source.is_file():
        if source.suffix.lower() in UNSTITCHED_SUFFIXES:
            problem = f"{source} is a file of a 360° camera, as it stores it"
            raise InputError(f"{problem}: stitch it to a panorama or film of 2:1 with the camera's program.")
        return [], True, {}, []
    if not source.is_dir():
        raise InputError(f"{source} does not exist; give a folder of photos or of videos, or a video.")
    photos, masks, others = look_into(source, out)
    if len(photos) < 3:
        videos = find_videos(source)
        if videos:
            unused = []
            if photos:
                unused.append(f"Its photos ({len(photos)}, such as {photos[0]}) are not used: fewer than 3.")
            return videos, True, {}, [*unused, *others]
        problem = f"{source} holds {len(photos)} photos; a reconstruction needs at least 3, better 30 or more."
        archives = [name for name in _visible_files(source) if is_archive(source / name)]
        if archives:
            problem += f" It holds archives ({len(archives)}, such as {archives[0]}): unpack them."
        raise InputError(" ".join([problem, *others]))
    for name in photos:
        if any(len(os.fsencode(part)) > _LONGEST_NAME for part in name.split("/")):
            problem = f"{source} holds a photo with a name of more than {_LONGEST_NAME} bytes, {name}"
            raise InputError(f"{problem}: rename it, since its mask and its copies have longer names.")
        if re.search(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]", name):  # macOS puts a narrow space into names.
            raise InputError(f"{source} holds a photo with unprintable characters in its name, {name!a}: rename it.")
    return photos, False, masks, others


def find_videos(folder: Path) -> list[str]:
    """Return the names of a folder's videos, relative to it, in order."""
    return [name for name in _visible_files(folder) if Path(name).suffix.lower() in VIDEO_SUFFIXES]


def _visible_files(folder: Path) -> list[str]:
    """Return the names of all files and broken links in a folder, sorted, without hidden ones, as macOS writes them.

    Folders that cannot be read are among them. Links to folders are followed, unless they lead to what is read anyway.
    Git repositories, results and runs in the folder are not looked into.
    """
    return _walk(folder)[0]


def is_result(folder: Path) -> bool:
    """Tell whether `sadgs` made a folder."""
    return (folder / "settings.json").is_file() and ((folder / "training").is_dir() or (folder / "log").is_dir())


def _is_foreign(folder: Path) -> bool:
    """Tell whether a folder is a git repository, a result of `sadgs`, or a run of nerfstudio."""
    return (folder / ".git").exists() or is_result(folder) or (folder / "nerfstudio_models").is_dir()


def _walk(folder: Path) -> tuple[list[str], list[str]]:
    """Return the names of visible files in a folder, and of the folders in it that are not looked into, both sorted."""
    paths = list[Path]()
    foreign = list[Path]()
    unread = list[OSError]()
    top = Path(os.path.realpath(folder))
    seen = {top, *top.parents}
    for parent, folders, files in os.walk(folder, onerror=unread.append, followlinks=True):
        paths += (path for path in (Path(parent, name) for name in files) if path.is_file() or not path.exists())
        real = {name: Path(os.path.realpath(Path(parent, name))) for name in folders}
        inner = {name for name in folders if Path(parent, name).is_symlink() and top in real[name].parents}
        entered = [name for name in folders if real[name] not in seen and name not in inner]
        others = [name for name in entered if _is_foreign(Path(parent, name))]
        foreign += (Path(parent, name) for name in others)
        folders[:] = [name for name in entered if name not in others]
        seen |= {real[name] for name in folders}
    paths += (Path(error.filename) for error in unread)
    names = (path.relative_to(folder).as_posix() for path in sorted(paths))
    left = (path.relative_to(folder).as_posix() for path in sorted(foreign))
    return [name for name in names if "/." not in f"/{name}"], [name for name in left if "/." not in f"/{name}"]


def images_of(cameras: Path, folder: Path) -> list[str]:
    """Return the images and masks of a capture that brings its cameras, relative to its folder.

    They are those that its file of cameras names, or with a COLMAP model those in the capture's folder itself, in
    `masks` and where the model's images are: renderings of a run may lie in other folders.
    """
    names = list[str]()
    keys = ("file_path", "mask_path")
    if cameras.suffix == ".json":
        with contextlib.suppress(InputError):  # Training tells what is wrong with the file, if it reads that one.
            frames = frames_of(read_json(cameras), cameras)
            names = [mended_name(folder, frame[key]) for frame in frames for key in keys if key in frame]
    else:
        images = [name for name in _visible_files(folder) if Path(name).suffix.lower() in IMAGE_SUFFIXES]
        tops = ("", "masks", *automatic_options(folder).images_path.parts[:1])
        names = [name for name in images if name.rpartition("/")[0].partition("/")[0] in tops]
    return [name for name in dict.fromkeys(names) if (folder / name).is_file()]


def look_into(source: Path, out: Path) -> tuple[list[str], dict[str, str], list[str]]:
    """Return the photos of a folder for a scene, their masks by photo, and sentences on the other images that it has.

    Names are relative to the folder. The scene's own photos stay photos. Hidden files and scenes' files are left out.
    """
    with contextlib.suppress(ImportError):  # In an older environment HEIC is left out.
        import pi_heif

        pi_heif.register_heif_opener()  # Pillow then reads HEIC, but not where poses are given: training would not.
    folder = Path(os.path.realpath(source))
    scene = Path(os.path.realpath(out))
    files, foreign = _walk(folder)
    settings = [folder / name for name in files if Path(name).parts[1:][-2:] == ("work", "settings.json")]
    scenes = {scene, *(path.parents[1] for path in settings)}
    known = {*read_settings(out / "work" / "settings.json", out).get("photos", [])}
    found = defaultdict(list)
    stems = defaultdict(list)
    masks_of = defaultdict(list)
    masks = {}
    for name in files:
        kind = ""
        if scenes.isdisjoint((folder / name).parents):
            kind = _kind(folder / name)
        if kind:
            if kind == "photos" and name not in known:
                others = {"thumbnails or trash": _SERVICE, "depth or other maps": _MAP, "masks": _MASK}
                kind = next((other for other, names in others.items() if names.fullmatch(name)), kind)
            found[kind].append(name)
    photo_stems = {_stem(name) for name in found["photos"]}
    maps = [name for name in found["masks"] if _is_mask(folder / name, _stem(name) in photo_stems)]
    photos = sorted({*found["photos"], *found["masks"]} - {*maps})
    found["copies of others"] = copies = _copies(folder, photos, known)
    found["panoramas of a part of the view"] = swept = [p for p in photos if p not in known and _is_swept(folder / p)]
    photos = [name for name in photos if name not in {*copies, *swept}]
    bands = other_bands(folder, photos, known)
    found.update(bands)
    photos = sorted({*photos}.difference(*bands.values()))
    for name in photos:
        stems[_stem(name)].append(name)
    for name in maps:
        candidates = stems[_stem(name)]
        if not candidates:
            found["masks of no photo"].append(name)
            continue
        photo = max(candidates, key=lambda photo: _fit_of_mask(name, photo))
        masks_of[photo].append(name)
    for photo, names in masks_of.items():
        masks[photo] = max(names, key=lambda name: _fit_of_mask(name, photo))
        found["further masks of a photo"] += [name for name in names if name != masks[photo]]
    own = {scene, *scene.parents}
    found["repositories or results of other work"] = [name for name in foreign if folder / name not in own]
    left = ((what, names) for what, names in found.items() if names and what not in ("photos", "masks"))
    return photos, masks, [f"Left out as {what}: {len(names)}, such as {names[0]}." for what, names in left]


def _kind(path: Path) -> str:
    """Return "photos" by a file's suffix and content, even if damaged, `_NOT_READ` for other images, or ""."""
    suffix = path.suffix.lower()
    if suffix in UNSTITCHED_SUFFIXES:
        return _UNSTITCHED
    kind = ""
    start = b""
    if path.is_dir():
        return "folders that cannot be read"
    with contextlib.suppress(OSError), path.open("rb") as file:  # What cannot be read is named later.
        start = file.read(12)
    if suffix in IMAGE_SUFFIXES and start[4:8] not in (b"ftyp", b"JXL ") and start[:2] != b"\xff\x0a":
        return "photos"
    with contextlib.suppress(*UNREADABLE), Image.open(path) as image:  # HEIC, AVIF, JPEG XL, or another suffix
        kind = image.format
    if suffix not in IMAGE_SUFFIXES | UNREAD_SUFFIXES:
        return _NOT_READ if kind in _FORMATS | {"GIF", "JPEG2000", "PSD", "PPM"} else ""
    return "photos" if kind in _FORMATS - {"TIFF"} else _NOT_READ


def _stem(name: str) -> str:
    """Return the part of a photo's name that its mask and copies share."""
    stem = Path(_VARIANT.sub("", Path(name).stem.lower()))
    return stem.stem if stem.suffix in IMAGE_SUFFIXES | UNREAD_SUFFIXES else stem.name


def _is_mask(path: Path, is_of_photo: bool) -> bool:
    """Return whether an image has two colours at most, or nearly all of it is black or white.

    One that has a photo's name may have any greys, as of a soft edge or noise: otherwise it would become a photo.
    """
    try:
        with Image.open(path) as image:
            if image.has_transparency_data:  # From a palette Pillow would warn.
                image = image.convert("RGBA")
            small = image.convert("RGB").resize((64, 64), Image.Resampling.NEAREST)
    except UNREADABLE:  # A damaged image is named when it is read.
        return False
    pixels = np.asarray(small).reshape(-1, 3)
    if is_of_photo and np.ptp(pixels, axis=1).max() <= _GREY_SPREAD:
        return True
    is_extreme = (pixels < 16).all(1) | (pixels > 239).all(1)
    return bool(is_extreme.mean() > 0.95 or len(np.unique(pixels, axis=0)) < 3)


def _fit_of_mask(mask: str, photo: str) -> tuple[int, int, bool, int]:
    """Return a key that is larger the better a mask's path fits a photo's.

    Where photos in several folders have one name, the mask is that of the folder that its own path names, or else of
    the photo nearest to the top. In one folder `b.jpg.png` is the mask of `b.jpg`, and not that of `b.png`.
    """
    folders = photo.split("/")[:-1]
    mask_folders = [folder for folder in mask.split("/")[:-1] if not _MASK.fullmatch(f"{folder}/")]
    equal_at_end = 0
    for folder, mask_folder in zip(reversed(folders), reversed(mask_folders), strict=False):
        if folder != mask_folder:
            break
        equal_at_end += 1
    equal = len({*folders} & {*mask_folders})
    has_full_name = Path(mask).stem == Path(photo).name
    return equal_at_end, equal, has_full_name, -len(folders)


def _is_swept(path: Path) -> bool:
    """Return whether a photo says that it is a panorama, but not of all directions: no lens shows it."""
    try:
        with Image.open(path) as image:
            size = image.size
            lens = Image.Image.getexif(image).get_ifd(ExifTags.IFD.Exif)
            xmp = image.info.get("xmp", b"")
    except UNREADABLE:  # A damaged photo is named when it is read.
        return False
    is_whole = size[0] == 2 * size[1]
    by_apple = lens.get(ExifTags.Base.CustomRendered) == 6
    return not is_whole and (by_apple or b"GPano:" in xmp)


def _copies(folder: Path, photos: Sequence[str], known: Collection[str]) -> list[str]:
    """Return the photos with the bytes of another, or with its name and about its content."""
    groups = defaultdict(list)
    copies = []
    for name in sorted(photos, key=len):
        size = 0
        if (folder / name).is_file():
            size = (folder / name).stat().st_size
        if size:
            groups[size].append(name)
            groups[_stem(name)].append(name)
    for names in (names for names in groups.values() if len(names) > 1):
        pixels = {name: math.prod(image_size(folder / name)) for name in names}
        names.sort(key=lambda name: (name not in known, -pixels[name]))
        for i, name in enumerate(names):
            if name not in {*known, *copies} and any(_is_copy(folder / name, folder / other) for other in names[:i]):
                copies.append(name)
    return copies


def _is_copy(photo: Path, other: Path) -> bool:
    """Return whether photos are equal, or have one name and differ in size, format or tone alone."""
    if filecmp.cmp(photo, other, shallow=False):
        return True
    if _stem(photo.name) != _stem(other.name):
        return False
    is_rig = photo.parent != other.parent and photo.suffix == other.suffix and image_size(photo) == image_size(other)
    if is_rig:
        return False
    one = _read_grey(photo)
    two = _read_grey(other)
    if one is None or two is None:
        return False
    small = [np.ravel(np.asarray(image.resize((16, 16), Image.Resampling.HAMMING))) for image in (one, two)]
    with np.errstate(invalid="ignore", divide="ignore"):  # of one colour
        is_alike = np.corrcoef(small)[0, 1] > 0.99  # Smaller copies of photos reach .999.
    return bool(is_alike and 0.97 < one.width * two.height / (one.height * two.width) < 1.03)


def _read_grey(path: Path) -> Image.Image | None:
    """Return a small grey version of a photo, upright, or None if it is damaged, as is said when it is read."""
    try:
        with Image.open(path) as image:
            image.draft("L", (64, 64))
            return ImageOps.exif_transpose(image).convert("L")
    except UNREADABLE:
        return None
