"""Camera motion: pose of every frame against a keyframe, relocalisation, smoothing of the poses."""
