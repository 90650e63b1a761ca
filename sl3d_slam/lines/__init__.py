"""Lines of one scan: a keyframe in, a :class:`~sl3d_slam.types.LineSet` out."""
