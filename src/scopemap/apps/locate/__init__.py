"""Where another video is in a result."""
