"""sensor_msgs/PointCloud2 messages to points, as described by their own field table."""

from typing import Any

import numpy as np

from sl3d_slam.errors import InputError
from sl3d_slam.io.points import Cloud, cloud_from_fields, find_time_field

_FORMATS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def cloud_from_message(message: Any, source: str) -> Cloud:
    """Return points and point times of a message; padding between points and rows is skipped.

    ``message`` is any object with the attributes of sensor_msgs/PointCloud2.

    Raises
    ------
    InputError
        naming ``source`` where the field table does not fit the bytes.
    """
    try:
        fields = _as_fields(message)
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise InputError(f"{source}: is a damaged PointCloud2 message ({error})") from None
    return cloud_from_fields(fields, source)


def _as_fields(message: Any) -> np.ndarray:
    order = ">" if message.is_bigendian else "<"
    time_field = find_time_field([field.name for field in message.fields])
    wanted = [
        f for f in message.fields if f.name.lower() in ("x", "y", "z") or f.name == time_field
    ]
    dtype = np.dtype(
        {
            "names": [field.name for field in wanted],
            "formats": [order + _FORMATS[field.datatype] for field in wanted],
            "offsets": [field.offset for field in wanted],
            "itemsize": message.point_step,
        }
    )
    used = message.width * message.point_step
    raw = np.frombuffer(message.data, np.uint8)
    if message.height > 1 and message.row_step != used:
        raw = raw[: message.height * message.row_step].reshape(message.height, message.row_step)
        raw = np.ascontiguousarray(raw[:, :used]).ravel()
    return np.frombuffer(raw, dtype, count=message.height * message.width)
