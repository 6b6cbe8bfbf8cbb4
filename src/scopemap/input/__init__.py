"""From a video, a folder, a data set or a camera file to frames with a camera."""
