"""Training of the package's own depth network: scenes, light, sensor, samples, network.

It stands outside the package: run it from the repository root, `python -m training.render --help`.
"""
