"""`python tests/panoramas_beside_photos.py FOLDER ITERATIONS`: held-out PSNR of panoramas and of photos of their views.

Twelve panoramas of the drawn hall, and 96 pinhole photos of the views that these are cut into, go through
`sadgs-process`, `ns-train sadgs-paper` and `ns-eval`, with the views of the same panorama held out.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from PIL import Image
from room import draw_panorama, draw_photo, panorama_centres

from sadgs_ns.cli.cameras.command import main as process
from sadgs_ns.cli.cameras.panoramas import VIEWS, rotations

COUNT, HEIGHT, TURN, SIZE = 12, 320, 0.3, 80


def draw(folder: Path) -> None:
    """Draw panoramas, and photos in folders named after them."""
    (folder / "panoramas").mkdir(parents=True)
    for i, centre in enumerate(panorama_centres(COUNT)):
        panorama, name = Image.fromarray(draw_panorama(centre, HEIGHT, TURN * i)), f"{i:02d}.jpg"
        panorama.save(folder / "panoramas" / name, quality=97, subsampling=0)
        (folder / "photos" / name).mkdir(parents=True)
        for view, rotation in enumerate(rotations()):
            photo = Image.fromarray(draw_photo(centre, rotation, HEIGHT // 2, TURN * i))
            photo.save(folder / "photos" / name / f"{view}.jpg", quality=97, subsampling=0)


def measure(folder: Path, source: str, iterations: int) -> None:
    """Make a scene of a source in the folder, train on it, and print the held-out PSNR."""
    scene, run = folder / f"{source}-scene", folder / "runs" / source / "sadgs-paper" / "latest"
    assert process([str(folder / source), str(scene), "--max-size", str(SIZE)]) == 0
    if source == "photos":
        described = json.loads((scene / "transforms.json").read_text())
        names = sorted(frame["file_path"] for frame in described["frames"])
        held_out = [name for name in names if "/04.jpg/" in name]
        described["train_filenames"] = [name for name in names if name not in held_out]
        described |= {"val_filenames": held_out, "test_filenames": held_out}
        (scene / "transforms.json").write_text(json.dumps(described))
    assert len(json.loads((scene / "transforms.json").read_text())["test_filenames"]) == VIEWS
    train = ["sadgs-paper", "--data", scene, "--output-dir", folder / "runs", "--experiment-name", source]
    train += ["--timestamp", "latest", "--vis", "tensorboard", "--max-num-iterations", iterations]
    train += ["--steps-per-eval-image", 0]
    evaluate = ["--load-config", run / "config.yml", "--output-path", folder / f"{source}.json"]
    for module, arguments in (("train", train), ("eval", evaluate)):
        command = [sys.executable, "-m", f"nerfstudio.scripts.{module}", *map(str, arguments)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    print(source, json.loads((folder / f"{source}.json").read_text())["results"])


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
    for what in ("panoramas", "photos"):
        measure(Path(sys.argv[1]), what, int(sys.argv[2]))
