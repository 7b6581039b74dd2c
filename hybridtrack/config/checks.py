"""Checks of matrices and of values by mode; each raises ScenarioError with place and remedy."""

import difflib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hybridtrack.config.reader import Document, Keys
from hybridtrack.models import Array

ROUNDING = 1e-9  # what decimals written by hand may leave over
# Rows of the tables, and how the figures' legends call them.
TAKEN_LABELS = ("raw", "truth", "measurement", "measurements", "noise_free")


def nearest(given: Any, names: Sequence[str]) -> str:
    """What to write instead of an unknown name: the one alike, or what there is to choose from."""
    lower = {name.lower(): name for name in names}
    close = difflib.get_close_matches(str(given).lower(), lower, 1, 0.7)
    if close and isinstance(given, str):
        return f"did you mean '{lower[close[0]]}'?"
    return f"there {'is' if len(names) == 1 else 'are'} {', '.join(names)}"


def matrix(rows: Sequence[Sequence[float]], document: Document, path: Keys) -> Array:
    """A matrix with rows of one length."""
    if not rows or not rows[0]:
        raise document.error(path, f"'{path[-1]}' is empty; give its rows: [[...], [...]]")
    for i, row in enumerate(rows):
        if len(row) != len(rows[0]):
            raise document.error(
                (*path, i),
                f"row {i + 1} of '{path[-1]}' has {len(row)} and row 1 has {len(rows[0])} numbers; "
                "make all rows equally long",
            )
    return np.array(rows, dtype=np.float64)


def shape(array: Array, wanted: tuple[int, int], document: Document, path: Keys, why: str) -> None:
    """A matrix of the shape that the modes, states and measurements want; `why` says so."""
    if array.shape != wanted:
        raise document.error(
            path,
            f"'{path[-1]}' is {array.shape[0]} x {array.shape[1]} and must be "
            f"{wanted[0]} x {wanted[1]}: {why}",
        )


def transition_matrix(
    rows: Sequence[Sequence[float]], names: tuple[str, ...], document: Document, path: Keys
) -> Array:
    """A row-stochastic matrix: row = from, column = to."""
    array = matrix(rows, document, path)
    shape(array, (len(names), len(names)), document, path, f"the modes are {', '.join(names)}")
    for i, row in enumerate(array):
        outside = np.flatnonzero((row < 0.0) | (row > 1.0))
        if outside.size:
            j = int(outside[0])
            raise document.error(
                (*path, i, j),
                f"entry {j + 1} of row {i + 1} of '{path[-1]}' is {row[j]:g}; a probability lies "
                "between 0 and 1",
            )
        if abs(row.sum() - 1.0) > ROUNDING:
            columns = np.abs(array.sum(axis=0) - 1.0).max() <= ROUNDING
            hint = (
                "the columns do, so write the transpose (row = from, column = to)"
                if columns
                else "row = from, column = to"
            )
            raise document.error(
                (*path, i),
                f"row {i + 1} of '{path[-1]}' (from {names[i]}) sums to {row.sum():.10g} and must "
                f"sum to 1; {hint}",
            )
    return array


def generator(
    rows: Sequence[Sequence[float]], names: tuple[str, ...], document: Document, path: Keys
) -> Array:
    """A generator: off the diagonal rates >= 0, rows that sum to 0."""
    array = matrix(rows, document, path)
    shape(array, (len(names), len(names)), document, path, f"the modes are {', '.join(names)}")
    for i, row in enumerate(array):
        negative = [j for j, rate in enumerate(row) if rate < 0 and j != i]
        if negative:
            raise document.error(
                (*path, i, negative[0]),
                f"entry {negative[0] + 1} of row {i + 1} of '{path[-1]}' is {row[negative[0]]:g}; "
                "only the diagonal is negative",
            )
        if abs(row.sum()) > ROUNDING * max(float(np.abs(row).max()), ROUNDING):
            raise document.error(
                (*path, i),
                f"row {i + 1} of '{path[-1]}' (from {names[i]}) sums to {row.sum():g} and must sum "
                "to 0; write minus the sum of the other rates on the diagonal",
            )
    return array


def covariance(
    rows: Sequence[Sequence[float]],
    of: Sequence[str],
    document: Document,
    path: Keys,
    definite: bool = False,
) -> Array:
    """A symmetric matrix, positive semidefinite or, where `definite`, positive definite.

    `of`: the names of the states or measurements that vary, n of them for (n, n).
    """
    array = matrix(rows, document, path)
    why = f"the {'measurements' if definite else 'states'} are {' '.join(of)}"
    shape(array, (len(of), len(of)), document, path, why)
    size = max(float(np.abs(array).max()), 1e-300)
    for i, variance in enumerate(np.diagonal(array).tolist()):
        if variance < 0:
            raise document.error(
                (*path, i, i),
                f"entry {i + 1} of row {i + 1} of '{path[-1]}' is {variance:g}; a variance is "
                "never negative",
            )
    if np.abs(array - array.T).max() > ROUNDING * size:
        i, j = divmod(int(np.argmax(np.abs(array - array.T))), len(array))
        raise document.error(
            (*path, j, i),
            f"'{path[-1]}' is not symmetric: entry {j + 1} of row {i + 1} is {array[i, j]:g} and "
            f"entry {i + 1} of row {j + 1} is {array[j, i]:g}; make them equal",
        )
    array = 0.5 * (array + array.T)
    smallest = float(np.linalg.eigvalsh(array)[0])
    if smallest < -ROUNDING * size:
        raise document.error(
            path,
            f"'{path[-1]}' is not positive semidefinite (an eigenvalue is {smallest:g}), so it is "
            "no covariance; check the entries off the diagonal",
        )
    if definite and smallest <= ROUNDING * size * 1e-6:
        raise document.error(
            path,
            f"'{path[-1]}' is not positive definite (an eigenvalue is {smallest:g}); give every "
            "measurement some noise",
        )
    return array


def noise_covariance(
    std: float | Sequence[float], dimensions: int, document: Document, path: Keys
) -> Array:
    """R of position noise from one standard deviation, or one per axis."""
    stds = [std] * dimensions if isinstance(std, int | float) else list(std)
    if len(stds) != dimensions:
        raise document.error(
            path,
            f"'{path[-1]}' needs one number, or one for each of {dimensions} dimensions, and has "
            f"{len(stds)}",
        )
    return np.diag(np.square(np.array(stds, dtype=np.float64)))


def by_mode(
    given: Any,
    names: tuple[str, ...],
    document: Document,
    path: Keys,
    defined: tuple[str, ...] = (),
) -> list[float]:
    """Values in the modes' order, from a list or from a mapping of the modes' names."""
    if isinstance(given, Mapping):
        for name in given:
            known_mode(name, names, document, (*path, name), defined)
        for name in names:
            if name not in given:
                raise document.error(path, f"'{path[-1]}' has no value for mode '{name}'; add it")
        return [float(given[name]) for name in names]
    if len(given) != len(names):
        raise document.error(
            path,
            f"'{path[-1]}' needs one number for each of the modes {', '.join(names)}, and has "
            f"{len(given)}",
        )
    return [float(value) for value in given]


def known_mode(
    name: str,
    names: tuple[str, ...],
    document: Document,
    path: Keys,
    defined: tuple[str, ...] = (),
) -> None:
    """A mode that is among `names`; one that is only `defined` belongs to no chain."""
    if name in defined and name not in names:
        raise document.error(
            path, f"mode '{name}' is left out of 'mean_sojourn_s', so it never acts; add it there"
        )
    if name not in names:
        there = nearest(name, names) if names else "the truth has no modes, so leave it out"
        raise document.error(path, f"mode '{name}' is not defined; {there}")


def label(name: str, document: Document) -> None:
    """An estimator's label that tables and figures can show."""
    if name in TAKEN_LABELS:
        raise document.error(
            ("estimators", name),
            f"'{name}' means something else in tables and figures; call it otherwise",
        )
    if name.startswith("_"):  # no legend of matplotlib's shows these
        raise document.error(
            ("estimators", name), f"'{name}' begins with _; begin with a letter or a digit"
        )
