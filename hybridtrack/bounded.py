"""Truth under bounded noise: every kind of it, and an adversary.

An ellipsoid Omega(0, Q) holds the noise that a set-membership filter believes in. Random noise
inside it is far from its worst, so a filter that leaves out what it must not may look right under
it: `persistent` noise stays at one place of the boundary for many steps, and an adversary chooses
what hurts one filter most. A box of the same half-axes is not inside: its corners are sqrt(n)
beyond. So isn't the printed noise of Otanez 2004, eq. 38, each component by itself a Gaussian that
"passes only values within +-sigma", whichever way that is read.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridtrack.ellipsoids import inverse, quadratic
from hybridtrack.models import Array
from hybridtrack.nonlinear import NonlinearModel
from hybridtrack.purposes import Purpose
from hybridtrack.roots import square_root

ELLIPSOID = ("none", "ball", "sphere", "persistent_ball", "adversary")
BOX = ("box", "persistent_box")
PRINTED = ("truncated_gaussian", "clipped_gaussian", "zeroed_gaussian")
KINDS = (*ELLIPSOID, *BOX, *PRINTED)
ASCENTS = 8  # of the adversary, each to the boundary point that the last one's slope points to
ROUNDING = 1e-9  # a point on the boundary may lie so far outside

Draws = Callable[[tuple[int, ...]], Array]


class Noise(NamedTuple):
    """How noise is drawn whose bound is the ellipsoid of `shape` (n, n)."""

    kind: str
    shape: Array
    hold_steps: int  # of the persistent kinds: steps until the signs are drawn again


class BoundedTruth(NamedTuple):
    """A nonlinear truth with bounded noise, from one start."""

    model: NonlinearModel
    start: Array  # (n_x,)
    spread: str  # none | ball | sphere: how starts lie in Omega(start, Sigma_0)
    process: Noise
    measurement: Noise
    against: str | None = None  # the filter that the adversary plays
    detection_probability: float = 1.0  # of a whole scan; NaN where it is missed


class NoiseRuns:
    """One noise of a block of runs, span by span."""

    def __init__(self, noise: Noise, generator: np.random.Generator, runs: int) -> None:
        """generator: the purpose's own stream, read on from span to span."""
        self._noise, self._generator, self._runs = noise, generator, runs
        self._root = square_root(noise.shape)
        self._signs: Array = np.zeros((runs, len(noise.shape)))
        self._step = 0

    def advance(self, steps: int) -> Array:
        """Noise (steps, runs, n) of the next steps; directions for an adversary."""
        n = len(self._noise.shape)
        shape = (steps, self._runs, n)
        kind = self._noise.kind
        if kind == "none":
            return np.zeros(shape)
        unit: Array
        if kind.startswith("persistent"):
            unit = self._held_signs(steps)
            if kind == "persistent_ball":
                unit /= np.sqrt(n)
        elif kind == "box":
            unit = self._generator.uniform(-1.0, 1.0, shape)
        elif kind in PRINTED:
            unit = printed(kind, self._generator, shape)
        else:
            # The first n components of a point on the sphere of n + 2 dimensions are uniform in the
            # ball of n; one kind of draw from the stream doesn't depend on the length of spans.
            more = 2 if kind == "ball" else 0
            drawn = self._generator.standard_normal((*shape[:2], n + more))
            length: Array = np.sqrt((drawn**2).sum(axis=-1, keepdims=True))
            unit = drawn[..., :n] / length
        result: Array = unit @ self._root.T
        return result

    def _held_signs(self, steps: int) -> Array:
        signs = np.empty((steps, *self._signs.shape))
        for k in range(steps):
            if self._step % self._noise.hold_steps == 0:
                drawn = self._generator.integers(0, 2, self._signs.shape)
                self._signs = (2 * drawn - 1).astype(np.float64)
            signs[k] = self._signs
            self._step += 1
        return signs


def printed(kind: str, generator: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Three readings of a standard Gaussian that "passes only values within +-1" (eq. 38).

    truncated: drawn again until inside; clipped: moved to the end; zeroed: nothing passes.
    """
    if kind == "truncated_gaussian":
        from scipy.special import ndtr, ndtri  # by the inverse of its distribution: one draw each

        low = ndtr(-1.0)
        truncated: Array = ndtri(low + (1.0 - 2.0 * low) * generator.random(shape))
        return truncated
    drawn = generator.standard_normal(shape)
    if kind == "clipped_gaussian":
        return np.clip(drawn, -1.0, 1.0)
    return np.where(np.abs(drawn) <= 1.0, drawn, 0.0)


def outside(noise: Array, shape: Array) -> Any:
    """Which draws (...,) of noise (..., n) lie outside Omega(0, shape)."""
    return quadratic(noise, np.broadcast_to(shape, (*noise.shape[:-1], *shape.shape))) > (
        1.0 + ROUNDING
    )


class Opponent(NamedTuple):
    """A filter as its adversary sees it: the ellipsoid at hand, and how it goes on."""

    centre: Array  # (lanes, n_x)
    shape: Array  # (lanes, n_x, n_x)
    advance: Callable[[Array], tuple[Array, Array]]  # measurements (lanes, n_y) -> the next two


class BoundedRuns:
    """States and measurements of the runs of a block, span by span."""

    def __init__(
        self,
        truth: BoundedTruth,
        stream: Callable[[Any], np.random.Generator],
        drawn: int,
        lanes: int,
    ) -> None:
        """stream: by purpose; drawn: runs drawn, of which the first `lanes` are kept."""
        self._truth, self._drawn, self._lanes = truth, drawn, lanes
        self._detection = stream(Purpose.DETECTION)
        self._process = NoiseRuns(truth.process, stream(Purpose.PROCESS_NOISE), drawn)
        self._measurement = NoiseRuns(truth.measurement, stream(Purpose.MEASUREMENT_NOISE), drawn)
        spread = Noise(truth.spread, truth.model.initial_shape, 1)
        offset = NoiseRuns(spread, stream(Purpose.INITIAL_STATE), drawn).advance(1)[0, :lanes]
        self.state = truth.start + offset
        self.opponent: Opponent | None = None
        self._step = 0

    def advance(self, steps: int) -> tuple[Array, Array, Array]:
        """States (steps, lanes, n_x), measurements (steps, lanes, n_y), and what lies outside.

        The last is (steps, lanes, 2): 1 where the process noise, and where the measurement noise,
        is outside the ellipsoid that filters believe in, else 0.
        """
        with np.errstate(all="ignore"):  # a truth that runs away is told by who scores it
            return self._advance(steps)

    def _advance(self, steps: int) -> tuple[Array, Array, Array]:
        model, lanes = self._truth.model, self._lanes
        w = self._process.advance(steps)[:, :lanes]
        v = self._measurement.advance(steps)[:, :lanes]
        missed = np.zeros((steps, lanes), dtype=np.bool_)
        if self._truth.detection_probability < 1.0:
            uniform = self._detection.random((steps, self._drawn))[:, :lanes]
            missed = uniform >= self._truth.detection_probability
        states = np.empty((steps, lanes, len(model.state_names)))
        measurements = np.empty((steps, lanes, len(model.measurement_names)))
        for k in range(steps):
            u = model.inputs_at(self._step)
            ahead = model.dynamics.value(self.state, u)
            if self._truth.against is not None:
                w[k] = self._push(ahead, w[k], u)
            self.state = states[k] = ahead + w[k]
            clean = model.measurement.value(self.state, u)
            if self._truth.against is not None:
                v[k] = self._hide(clean, v[k], u)
            measurements[k] = np.where(missed[k, :, np.newaxis], np.nan, clean + v[k])
            if self.opponent is not None:
                centre, shape = self.opponent.advance(measurements[k])
                self.opponent = self.opponent._replace(centre=centre, shape=shape)
            self._step += 1
        far = [outside(w, model.process_noise_shape), outside(v, model.measurement_noise_shape)]
        return states, measurements, np.stack(far, axis=-1).astype(np.float64)

    def _push(self, ahead: Array, direction: Array, u: Array) -> Array:
        """Process noise on the boundary that drives the state out of the predicted ellipsoid.

        It maximises (d + w)' M (d + w), d the error ahead and M the inverse of A Sigma A' + Q:
        convex, so the boundary point in the direction of the slope is never worse.
        """
        assert self.opponent is not None
        model, Q = self._truth.model, self._truth.process.shape
        A = model.dynamics.jacobian(self.opponent.centre, u)
        M = inverse(A @ self.opponent.shape @ np.swapaxes(A, -1, -2) + Q)
        d = ahead - model.dynamics.value(self.opponent.centre, u)
        w = np.where(np.einsum("bi,bij,bj->b", d, M, direction)[:, None] < 0, -direction, direction)
        for _ in range(ASCENTS):
            w = _to_boundary(np.einsum("bij,bj->bi", M, d + w) @ Q, Q, w)
        return w

    def _hide(self, clean: Array, direction: Array, u: Array) -> Array:
        """Measurement noise on the boundary that leaves the filter the smallest innovation.

        In the fused ellipsoid the state is at (a - delta)/(1 - delta), with a the weighed distances
        before, which grows with the noise's own and falls with the innovation's, delta.
        """
        assert self.opponent is not None
        model, R = self._truth.model, self._truth.measurement.shape
        guess = model.dynamics.value(self.opponent.centre, u)
        error = clean - model.measurement.value(guess, u)
        return _to_boundary(-error, R, direction)


def _to_boundary(vector: Array, shape: Array, otherwise: Array) -> Array:
    """Vectors (lanes, n) stretched to the boundary of Omega(0, shape), if they have a length."""
    length = np.sqrt(quadratic(vector, shape))
    with np.errstate(all="ignore"):
        stretched = vector / length[:, np.newaxis] * (1.0 - 1e-12)
    sound: NDArray[np.bool_] = np.asarray(np.isfinite(stretched).all(axis=1))
    return np.where(sound[:, np.newaxis], stretched, otherwise)
