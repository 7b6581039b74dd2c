"""Checks of matrices and of values by mode; each raises ScenarioError with place and remedy."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hybridtrack.config.reader import Document, Keys
from hybridtrack.models import Array

ROUNDING = 1e-9  # what decimals written by hand may leave over


def matrix(rows: Sequence[Sequence[float]], document: Document, path: Keys) -> Array:
    """A matrix with rows of one length."""
    lengths = {len(row) for row in rows}
    if len(lengths) != 1 or 0 in lengths:
        raise document.error(path, f"'{path[-1]}' needs rows of one length, one or more")
    return np.array(rows, dtype=np.float64)


def shape(array: Array, wanted: tuple[int, int], document: Document, path: Keys) -> None:
    """A matrix of the shape that the states and measurements want."""
    if array.shape != wanted:
        raise document.error(
            path,
            f"'{path[-1]}' is {array.shape[0]} x {array.shape[1]} and must be "
            f"{wanted[0]} x {wanted[1]}",
        )


def transition_matrix(
    rows: Sequence[Sequence[float]], names: tuple[str, ...], document: Document, path: Keys
) -> Array:
    """A row-stochastic matrix: row = from, column = to."""
    array = matrix(rows, document, path)
    shape(array, (len(names), len(names)), document, path)
    for i, row in enumerate(array):
        outside = [p for p in row if not 0.0 <= p <= 1.0]
        if outside:
            raise document.error(
                (*path, i), f"'{path[-1]}' holds {outside[0]:g}; probabilities lie in 0 to 1"
            )
        if abs(row.sum() - 1.0) > ROUNDING:
            columns = np.abs(array.sum(axis=0) - 1.0).max() <= ROUNDING
            hint = (
                "the columns do: write the transpose (row = from, column = to)"
                if columns
                else "row = from, column = to"
            )
            raise document.error(
                (*path, i),
                f"row {i + 1} of '{path[-1]}' (from {names[i]}) sums to {row.sum():.10g} and rows "
                f"must sum to 1; {hint}",
            )
    return array


def generator(
    rows: Sequence[Sequence[float]], names: tuple[str, ...], document: Document, path: Keys
) -> Array:
    """A generator: off the diagonal rates >= 0, rows that sum to 0."""
    array = matrix(rows, document, path)
    shape(array, (len(names), len(names)), document, path)
    for i, row in enumerate(array):
        if (np.delete(row, i) < 0).any():
            raise document.error(
                (*path, i), f"row {i + 1} of '{path[-1]}' holds a negative rate off its diagonal"
            )
        if abs(row.sum()) > ROUNDING * max(float(np.abs(row).max()), ROUNDING):
            raise document.error(
                (*path, i),
                f"row {i + 1} of '{path[-1]}' (from {names[i]}) sums to {row.sum():g} and must sum "
                "to 0: the diagonal is minus the sum of the rates",
            )
    return array


def covariance(
    rows: Sequence[Sequence[float]],
    n: int,
    document: Document,
    path: Keys,
    definite: bool = False,
) -> Array:
    """A symmetric matrix (n, n), positive semidefinite or, where `definite`, positive definite."""
    array = matrix(rows, document, path)
    shape(array, (n, n), document, path)
    size = max(float(np.abs(array).max()), 1e-300)
    negative = [float(v) for v in np.diagonal(array) if v < 0]
    if negative:
        raise document.error(path, f"'{path[-1]}' holds the negative variance {negative[0]:g}")
    if np.abs(array - array.T).max() > ROUNDING * size:
        i, j = np.unravel_index(np.argmax(np.abs(array - array.T)), array.shape)
        raise document.error(
            path,
            f"'{path[-1]}' is not symmetric: [{i + 1}][{j + 1}] is {array[i, j]:g} and "
            f"[{j + 1}][{i + 1}] is {array[j, i]:g}; make them equal",
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
            path, f"'{path[-1]}' must be positive definite: every measurement has some noise"
        )
    return array


def noise_covariance(
    std: float | Sequence[float], dimensions: int, document: Document, path: Keys
) -> Array:
    """R of position noise from one standard deviation, or one per axis."""
    stds = [std] * dimensions if isinstance(std, int | float) else list(std)
    if len(stds) != dimensions:
        raise document.error(
            path, f"'{path[-1]}' has {len(stds)} numbers for {dimensions} dimensions"
        )
    return np.diag(np.square(np.array(stds, dtype=np.float64)))


def by_mode(given: Any, names: tuple[str, ...], document: Document, path: Keys) -> list[float]:
    """Values in the modes' order, from a list or from a mapping of the modes' names."""
    if isinstance(given, Mapping):
        for name in given:
            known_mode(name, names, document, (*path, name))
        for name in names:
            if name not in given:
                raise document.error(path, f"'{path[-1]}' has no value for mode '{name}'; add it")
        return [float(given[name]) for name in names]
    if len(given) != len(names):
        raise document.error(
            path, f"'{path[-1]}' has {len(given)} values for the {len(names)} modes {names}"
        )
    return [float(value) for value in given]


def known_mode(name: str, names: tuple[str, ...], document: Document, path: Keys) -> None:
    """A mode that is defined."""
    if name not in names:
        there = f"there are {', '.join(names)}" if names else "the truth has no modes"
        raise document.error(path, f"mode '{name}' is not defined; {there}")
