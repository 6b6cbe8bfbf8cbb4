"""Numbers only: poses, depth and surfaces against the truth; knows no stage of the pipeline."""
