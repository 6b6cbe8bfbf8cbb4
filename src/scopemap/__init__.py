"""scopemap: from a monocular endoscope video to camera poses and a tissue surface."""
