"""Studies over run folders."""
