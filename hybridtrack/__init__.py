"""State estimation in stochastic hybrid systems, with aircraft tracking as its home."""

__version__ = "0.1.0"
