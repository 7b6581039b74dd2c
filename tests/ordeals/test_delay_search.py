"""How often condition 1 of proposition 4.2 is satisfied in figure 4 of Hwang 2006, over noises.

The paper leaves its noises out. 126 settings about those that give its simulated delays: seven
standard deviations of the measurement, CV's; six ratios of CT's to it; three process noises. Not
part of the tests: it takes a minute, and says what configs/mode_delay_fig4.yaml claims.
"""

import numpy as np

from hybridtrack import config
from hybridtrack.analyses._mean_course import courses, run_mean_bank, start, states_of_bank
from hybridtrack.analyses._propositions import bounds, rival
from hybridtrack.analyses._steady_filters import steady_filters

STDS_M = (0.05, 0.1, 0.15, 0.209, 0.3, 0.5, 1.0)
RATIOS = (0.5, 0.75, 1.0, 1.5, 1.95, 3.0)
NOISES = (0.003, 0.0088, 0.03)


def test_condition_1_over_126_noises():
    experiment = config.load("mode_delay_fig4")
    (course,) = courses(experiment)
    truth = states_of_bank(course, experiment.bank.state_names)
    satisfied = {1: 0, 2: 0}
    tried = 0
    for std_m in STDS_M:
        for ratio in RATIOS:
            for noise in NOISES:
                modes = tuple(
                    mode._replace(
                        measurement_noise_covariance=(std_m * factor) ** 2 * np.eye(2),
                        matrices=mode.matrices._replace(
                            process_noise_covariance=(noise * more) ** 2 * np.eye(4)[np.newaxis]
                        ),
                    )
                    for mode, factor, more in zip(
                        experiment.bank.modes, (1.0, ratio), (1.0, 1.67), strict=True
                    )
                )
                bank = experiment.bank._replace(modes=modes)
                changed = experiment._replace(bank=bank)
                model = bank.discretise(
                    np.ones(1), experiment.initial.mean, experiment.initial.covariance
                )
                filters = steady_filters(model)
                for chosen in experiment.estimators:
                    mean, _, _ = start(changed, course, chosen)
                    run = run_mean_bank(
                        filters, model, course.measurements, mean, chosen.label == "IMM"
                    )
                    for switch in course.switches:
                        new = bank.names.index(switch.to_mode)
                        one = rival(
                            run,
                            switch,
                            filters,
                            new,
                            1 - new,
                            truth,
                            model.transition_matrix[0],
                            True,
                        )
                        found = bounds([one])["proposition_4_2_condition_1"].delay_steps
                        satisfied[switch.number] += bool(np.isfinite(found))
                tried += 1
    assert tried == 126
    assert satisfied[1] == 0  # CV to CT
    assert 0 < satisfied[2] < 126
