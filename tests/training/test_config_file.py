"""A run's config.yml is read without executing what it names."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from sadgs_ns.training.config_file import ConfigLoader
from sadgs_ns.training.presets import sadgs

OLD_RUNS = Path(__file__).parents[1] / "old_runs"


def test_options_are_read_as_pyyaml_s_full_loader_reads_them():
    text = yaml.dump(sadgs.config)
    actual = yaml.dump(yaml.load(text, Loader=ConfigLoader))
    assert actual == text


@pytest.mark.parametrize("run", sorted(OLD_RUNS.iterdir()), ids=lambda run: run.name)
def test_options_of_earlier_versions_are_read_too(run: Path):
    text = (run / "run/config.yml").read_text("utf8")
    expected = yaml.load(text, Loader=yaml.Loader)
    actual = yaml.dump(yaml.load(text, Loader=ConfigLoader))
    assert actual == yaml.dump(expected)


@pytest.mark.hard_case("`sadgs-inspect` of a config.yml that runs a program", "refused, and nothing is run")
@pytest.mark.parametrize(
    "text",
    [
        "!!python/object/apply:os.system ['touch {file}']",
        "!!python/object/apply:nerfstudio.utils.scripts.run_command ['touch {file}']",
        "!!python/object/apply:subprocess.Popen [[touch, '{file}']]",
        "!!python/object/new:subprocess.Popen [[touch, '{file}']]",
        "!!python/object:subprocess.Popen {{args: [touch, '{file}']}}",
        "{{_target: !!python/name:subprocess.Popen ''}}",
        "{{_target: !!python/name:nerfstudio.utils.scripts.run_command ''}}",
        "{{_target: !!python/name:nerfstudio.utils.scripts.subprocess.Popen ''}}",
        "{{_target: !!python/name:sadgs_ns.training.config.Path ''}}",
        "!!python/module:antigravity ''",
        "!!python/object:sadgs_ns.training.no_such_module.Options {{}}",
    ],
)
def test_other_code_is_refused_and_not_run(text: str, tmp_path: Path):
    file = tmp_path / "made"
    with pytest.raises(yaml.YAMLError):
        yaml.load(text.format(file=file), Loader=ConfigLoader)
    assert not file.exists()
