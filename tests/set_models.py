"""The paper's two aircraft, and block runs of filters on them, for the tests of sets."""

import numpy as np

from hybridtrack import bounded, ellipsoids, maps, remainders
from hybridtrack import expressions as ex
from hybridtrack.estimators import estimators
from hybridtrack.nonlinear import NonlinearModel
from hybridtrack.simulation import stream

NAMES = ("x", "y", "psi")
Q, R = np.eye(3) * 0.01**2, np.eye(2) * 0.09**2
POINTS = [[0.0, 0.0, 0.22], [0.0, 0.0, 0.82], [0.0, 0.0, 1.35]]
RESET = {"operation": "bank_reset", "operating_points": POINTS}
PARALLEL = {"operation": "bank_parallel", "operating_points": POINTS}
STEPS = 314


def system(texts, names=NAMES):
    """A compiled map of texts in the names of states."""
    symbols = maps.symbols(names, "state")
    env = dict(zip(names, symbols, strict=True))
    return maps.compiled([ex.parse(text, env) for text in texts], symbols, ())


def aircraft(contains_box=False, dynamics=None, measurement=("x", "y")):
    """Otanez 2004, section IV; filters believe in 3 Q and 2 R where they contain the box."""
    moved = system(dynamics or ("x + .1*cos(psi)", "y + .1*sin(psi)", "psi + .005"))
    seen = system(measurement)
    many = (3, 2) if contains_box else (1, 1)
    return NonlinearModel(
        dynamics=moved,
        measurement=seen,
        dynamics_remainder=remainders.remainder(moved),
        measurement_remainder=remainders.remainder(seen),
        state_names=NAMES,
        measurement_names=("x", "y"),
        angles=(2,),
        inputs=np.zeros((1, 0)),
        process_noise_shape=many[0] * Q,
        measurement_noise_shape=many[1] * R,
        initial_shape=0.01 * np.eye(3),
    )


def truth(model, kind, spread="none", against=None):
    """A truth whose noise has the half-axes of Q and R, whatever filters believe."""
    process, measurement = (bounded.Noise(kind, shape, 40) for shape in (Q, R))
    return bounded.BoundedTruth(model, np.zeros(3), spread, process, measurement, against)


def simulated(model, kind, runs, steps=STEPS, seed=1, spread="none"):
    """States (steps, runs, 3) and measurements (steps, runs, 2), in blocks' own way."""
    whole = bounded.BoundedRuns(
        truth(model, kind, spread), lambda purpose: stream(seed, 0, 0, purpose), runs, runs
    )
    states, measurements, _ = whole.advance(steps)
    return states, measurements


def begun(model, settings, runs, name="esmf"):
    estimator = estimators()[name]
    chosen = estimator.settings(**settings)
    return estimator.begin(chosen, estimator.prepare(chosen, model), np.zeros((3, runs)))


class Outcome:
    """What a filter made of some runs."""

    def __init__(self, states, mean, sets):
        shape = np.moveaxis(sets.shape, -1, 1)
        self.centre, self.shape = np.swapaxes(mean, 1, 2), shape
        self.distance = ellipsoids.quadratic(states - self.centre, shape)
        self.diverged = np.isnan(self.centre[:, :, 0]).any(axis=0)
        largest = np.fmax.reduce(self.distance, axis=0)
        self.empty = sets.empty.any(axis=0)
        self.violated = (largest > 1 + 1e-9) | self.empty
        self.largest = float(np.nanmax(largest))
        self.heading = np.sqrt(shape[:, :, 2, 2])
        self.chosen = sets.chosen
        by_run = np.where(self.diverged, np.inf, self.heading.mean(axis=0))
        self.median_heading = float(np.median(by_run))


def filtered(model, settings, states, measurements, name="esmf"):
    """The outcome of one filter on simulated runs."""
    running = begun(model, settings, states.shape[1], name)
    found = running.advance(None, np.ascontiguousarray(np.swapaxes(measurements, 1, 2)))
    return Outcome(states, found.mean, running.sets)


def opposed(model, settings, runs, steps=STEPS, seed=1, spread="sphere"):
    """The outcome of a filter against its adversary."""
    whole = bounded.BoundedRuns(
        truth(model, "adversary", spread, "it"),
        lambda purpose: stream(seed, 0, 0, purpose),
        runs,
        runs,
    )
    shadow = begun(model, settings, runs)

    def advance(measurements):
        found = shadow.advance(None, np.ascontiguousarray(measurements.T)[np.newaxis])
        return found.mean[0].T, np.moveaxis(shadow.sets.shape[0], -1, 0)

    start = np.tile(model.initial_shape, (runs, 1, 1))
    whole.opponent = bounded.Opponent(np.zeros((runs, 3)), start, advance)
    states, measurements, outside = whole.advance(steps)
    assert not outside.any()
    return filtered(model, settings, states, measurements)
