"""The tensors that a network of given settings has."""

from sl3d_slam.lines.network.settings import NetworkSettings

HIDDEN = 16
EXCHANGES = 2
RINGS = 5


def num_inputs(settings: NetworkSettings) -> int:
    """Return how many numbers the first block sees of an edge."""
    if settings.scale_invariant:
        return 6
    return 4 if settings.heights else 3


def expected_shapes(settings: NetworkSettings) -> dict[str, tuple[int, ...]]:
    """Return the shape of every weight by its name in :class:`~.model.SuperLine3D`."""
    width = settings.width
    joined = (4 if settings.context else 3) * width
    shapes = _layer("blocks.0.first", num_inputs(settings), HIDDEN)
    shapes |= _layer("blocks.0.second", HIDDEN, width) | _norm("blocks.0.norm", width)
    for block in ("blocks.1", "blocks.2"):
        shapes |= _layer(f"{block}.centre", width, width) | _norm(f"{block}.norm", width)
        shapes[f"{block}.edge.weight"] = (width, width)
    if settings.context:
        shapes |= _layer("context.lift", 3 * width, width)
        for exchange in range(EXCHANGES):
            shapes |= _exchange(f"context.exchanges.{exchange}", width)
    shapes |= _layer("segmentation.0", joined, width) | _layer("segmentation.2", width, 2)
    shapes |= _layer("descriptor.0", joined, 2 * width)
    shapes |= _layer("descriptor.2", 2 * width, settings.descriptor_dim)
    if settings.surroundings:
        heard = (1 + RINGS) * settings.descriptor_dim
        shapes |= _layer("surroundings", heard, settings.descriptor_dim)
    return shapes


def _exchange(name: str, width: int) -> dict[str, tuple[int, ...]]:
    shapes = _layer(f"{name}.centre", width, width) | _layer(f"{name}.mix", width, width)
    shapes |= {f"{name}.edge.weight": (width, width), f"{name}.gap.weight": (width, 2)}
    return shapes | _norm(f"{name}.norm", width)


def _layer(name: str, channels_in: int, channels_out: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": (channels_out, channels_in), f"{name}.bias": (channels_out,)}


def _norm(name: str, width: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": (width,), f"{name}.bias": (width,)}
