"""Where the keyframes are by somebody else's solution, carried on by odometry."""

from collections.abc import Mapping

from sl3d_slam.geometry.se3 import Transform, invert


class LivePoses:
    """``T_world_lidar`` of every keyframe, by id, in the order they were added.

    The world frame is the odometry's until :meth:`update` brings another.
    """

    def __init__(self) -> None:
        self._T_world_lidar: dict[int, Transform] = {}
        self._T_odom_last: Transform | None = None

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self._T_world_lidar)

    def __getitem__(self, keyframe_id: int) -> Transform:
        """Return ``T_world_lidar`` of one keyframe."""
        return self._T_world_lidar[keyframe_id]

    def add(self, keyframe_id: int, T_odom_lidar: Transform) -> Transform:
        """Continue from the last keyframe by odometry; return the new ``T_world_lidar``."""
        T_world_lidar = T_odom_lidar
        if self._T_odom_last is not None:
            T_world_last = next(reversed(self._T_world_lidar.values()))
            T_world_lidar = T_world_last @ invert(self._T_odom_last) @ T_odom_lidar
        self._T_world_lidar[keyframe_id] = T_world_lidar
        self._T_odom_last = T_odom_lidar
        return T_world_lidar

    def update(self, known: Mapping[int, Transform]) -> None:
        """Take over the known poses; every other keyframe moves with the known one before it.

        Those before the first known one move with that. Nothing happens where none is known.
        """
        if not known:
            return
        first = next(k for k in self._T_world_lidar if k in known)
        T_new_old = known[first] @ invert(self._T_world_lidar[first])
        for keyframe_id, T_old_lidar in self._T_world_lidar.items():
            T_new_lidar = known.get(keyframe_id)
            if T_new_lidar is None:
                T_new_lidar = T_new_old @ T_old_lidar
            else:
                T_new_old = T_new_lidar @ invert(T_old_lidar)
            self._T_world_lidar[keyframe_id] = T_new_lidar

    def all(self) -> dict[int, Transform]:
        """Return ``T_world_lidar`` by id."""
        return dict(self._T_world_lidar)
