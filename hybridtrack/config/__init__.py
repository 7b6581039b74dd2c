"""From a YAML file to a frozen Experiment: the only room that knows yaml, pydantic and units."""

from collections.abc import Sequence
from pathlib import Path

from hybridtrack.compiled import PACKAGE
from hybridtrack.config.build import build
from hybridtrack.config.checks import nearest
from hybridtrack.config.json_form import json_schema
from hybridtrack.config.nonlinear import build_nonlinear
from hybridtrack.config.nonlinear_form import NonlinearForm
from hybridtrack.config.reader import Document, ScenarioError, read
from hybridtrack.config.validate import validate
from hybridtrack.config.writer import dump
from hybridtrack.description import ChosenEstimator, Experiment, Initial, Window

__all__ = [
    "ChosenEstimator",
    "Document",
    "Experiment",
    "Initial",
    "ScenarioError",
    "Window",
    "dump",
    "find",
    "json_schema",
    "load",
    "nearest",
    "read",
    "shipped",
]


def shipped() -> dict[str, Path]:
    """The scenarios that come with the package, by name."""
    for folder in (PACKAGE / "configs", PACKAGE.parent / "configs"):
        if folder.is_dir():
            return {path.stem: path for path in sorted(folder.glob("*.yaml"))}
    return {}


def find(config: str) -> Path:
    """The file of a scenario given by its path, or by the name of a shipped one."""
    path = Path(config)
    try:
        found = path.exists() and not (path.is_dir() and config in shipped())
    except OSError:
        found = True  # reading it tells what is in the way
    if found:
        return path
    if config in shipped():
        return shipped()[config]
    if not path.suffix and path.name == config:
        raise ScenarioError(
            f"{config}: there is no such file, and no scenario of that name is shipped; "
            f"{nearest(config, tuple(shipped()))}"
        )
    return path


def load(config: str | Path, settings: Sequence[str] = ()) -> Experiment:
    """The experiment of a scenario, after `key.path=value` settings.

    Raises ScenarioError: one sentence with file, line, column, key, value and remedy.
    """
    path = find(str(config))
    document = read(path)
    for setting in settings:
        document = document.with_setting(setting)
    form = validate(document)
    if isinstance(form, NonlinearForm):
        return build_nonlinear(form, document)
    return build(form, document, path.parent)
