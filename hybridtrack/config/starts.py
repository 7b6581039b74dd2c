"""How filters, or a chain's truth, start: from the truth, from numbers, from the first scans."""

import numpy as np

from hybridtrack.config import checks
from hybridtrack.config.reader import Document, Keys
from hybridtrack.config.schema import InitialForm
from hybridtrack.description import Initial
from hybridtrack.models import ModeBank

# By what a state's name is before its axis.
STD_KEYS = {"": "position_std_m", "v": "velocity_std_m_s", "a": "acceleration_std_m_s2"}


def initial(form: InitialForm, bank: ModeBank, document: Document, path: Keys) -> Initial:
    n_x = len(bank.state_names)
    stds = {kind: getattr(form, key) for kind, key in STD_KEYS.items()}
    spread = form.covariance is not None or any(std is not None for std in stds.values())
    if form.from_measurements is not None:
        if form.mean is not None or spread:
            raise document.error(
                (*path, "from_measurements"),
                "a start from measurements needs no mean and no spread; remove them",
            )
        wanted = {kind + axis for axis in "xy"[: bank.dimensions] for kind in ("", "v")}
        known = wanted | {"a" + axis for axis in "xy"[: bank.dimensions]}
        if not wanted <= set(bank.state_names) <= known:
            raise document.error(
                (*path, "from_measurements"),
                f"a start from two scans gives positions and velocities, and the states are "
                f"{' '.join(bank.state_names)}; give 'mean' and 'covariance' instead",
            )
        return Initial(True, False, False, np.zeros(n_x), np.zeros((n_x, n_x)))
    if form.mean is None:
        raise document.error(
            path,
            "'mean' is missing; add truth, drawn_about_truth or a number per state "
            "(or from_measurements: two_point)",
        )
    covariance = np.zeros((n_x, n_x))
    if form.covariance is not None:
        if len([s for s in stds.values() if s is not None]):
            raise document.error(
                (*path, "covariance"), "'covariance' says all; remove the standard deviations"
            )
        covariance = checks.covariance(
            form.covariance, bank.state_names, document, (*path, "covariance")
        )
    elif spread:
        kinds = [name[:-1] if name[-1:] in ("x", "y") else "?" for name in bank.state_names]
        for kind, name in zip(kinds, bank.state_names, strict=True):
            if stds.get(kind) is None:
                add = STD_KEYS.get(kind, "covariance")
                raise document.error(path, f"the spread of state '{name}' is missing; add '{add}'")
        covariance = np.diag([float(stds[kind] or 0.0) ** 2 for kind in kinds])
    if form.mean == "drawn_about_truth" and not spread:
        raise document.error(
            (*path, "mean"),
            "a start drawn about the truth needs a spread; add 'position_std_m' and so on, or "
            "'covariance'",
        )
    if isinstance(form.mean, str):
        drawn = form.mean == "drawn_about_truth"
        return Initial(False, True, drawn, np.zeros(n_x), covariance)
    mean = np.array(form.mean, dtype=float)
    if mean.shape != (n_x,):
        raise document.error(
            (*path, "mean"),
            f"'mean' needs one number for each of the states {' '.join(bank.state_names)}, and "
            f"has {mean.size}",
        )
    return Initial(False, False, False, mean, covariance)
