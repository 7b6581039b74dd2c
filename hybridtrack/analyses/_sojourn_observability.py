"""Condition 1 of Hwang 2003, Theorem 3: the tests of section 2 there, and Vidal's rank."""

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from hybridtrack.analyses._observability_matrices import (
    ModeDynamics,
    initial_mode_test,
    joint_observability_index,
    mode_dynamics,
    observability_matrix,
    rank,
    transition_test_as_printed,
)
from hybridtrack.models import Array, JumpMarkovModel


class JointObservability(NamedTuple):
    """What condition 1 of Theorem 3 asks; None where there is no such number of steps."""

    state_steps: int | None  # outputs until every mode's state shows (the paper's tau)
    joint_index: int | None  # Vidal: outputs until [O_i O_j] has rank 2n for every two modes
    covariance_steps: int | None  # outputs until Lemma 2 holds for every two modes
    same_covariances: tuple[tuple[str, str], ...]  # pairs that Lemma 2 never tells apart
    unseen_switches: tuple[tuple[str, str], ...]  # from, to: where Lemma 3 doesn't hold

    @property
    def met(self) -> bool:
        """Lemma 2 and Lemma 3, which are Theorem 1."""
        return self.covariance_steps is not None and not self.unseen_switches


def joint_observability(model: JumpMarkovModel, second_moment: Array) -> JointObservability:
    """Whether modes and switches are told by outputs; model with n_times = 1.

    second_moment (n_x, n_x) is the paper's Pi_0 = E[x_0 x_0']. Lemma 2 compares the covariances
    of all outputs so far under either mode, Lemma 3 those of the first output after a switch; its
    instant is taken at tau steps after the start. Inputs count in neither, as in the paper.
    """
    modes = mode_dynamics(model._replace(initial_covariance=second_moment))
    n = len(second_moment)
    pairs = [(one, other) for i, one in enumerate(modes) for other in modes[i + 1 :]]
    index = joint_observability_index(model)
    state_steps = int(index) if math.isfinite(index) else None

    def both(steps: int) -> bool:
        return all(
            rank(
                np.hstack(
                    [
                        observability_matrix(m.state_transition, m.measurement_matrix, steps)
                        for m in pair
                    ]
                )
            )
            == 2 * n
            for pair in pairs
        )

    # The covariances of two modes' states obey one recursion of order n (n + 1), to which Q adds a
    # constant: outputs that are alike so often and once more are alike for ever.
    most = n * (n + 1) + 1

    def apart(one: ModeDynamics, other: ModeDynamics) -> int | None:
        return _first(range(1, most + 1), lambda steps: initial_mode_test(one, other, steps).differ)

    with np.errstate(over="ignore", invalid="ignore"):  # of a mode that runs away
        told = [apart(*pair) for pair in pairs]
        unseen = tuple(
            (old.name, new.name)
            for old in modes
            for new in modes
            if old is not new and not transition_test_as_printed(old, new, state_steps or n).differ
        )
    known = [steps for steps in told if steps is not None]
    covariance_steps = None
    if state_steps is not None and len(known) == len(pairs):
        covariance_steps = max([state_steps, *known])
    return JointObservability(
        state_steps,
        _first(range(1, 2 * n + 1), both),
        covariance_steps,
        tuple(
            (one.name, other.name)
            for (one, other), steps in zip(pairs, told, strict=True)
            if steps is None
        ),
        unseen,
    )


def _first(numbers: Iterable[int], holds: Callable[[int], bool]) -> int | None:
    return next((number for number in numbers if holds(number)), None)
