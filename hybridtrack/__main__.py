"""`python -m hybridtrack`."""

from hybridtrack.cli import main

main()
