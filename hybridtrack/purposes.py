"""What random streams are for; a stream is keyed (seed, case, block, purpose)."""

import enum


class Purpose(enum.IntEnum):
    """What a random stream is for."""

    INITIAL_STATE = 0
    MODE_SEQUENCE = 1
    PROCESS_NOISE = 2
    MEASUREMENT_NOISE = 3
    DETECTION = 4
    OUTLIERS = 5
    INITIAL_ESTIMATE = 6
