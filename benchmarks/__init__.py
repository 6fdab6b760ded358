"""Time and accuracy, measured beside named peers in the same run: ``python -m benchmarks --help``."""
