"""Camera calibration: with a checkerboard or ChArUco board, or (`focal_length`) of an unknown camera from motion."""
