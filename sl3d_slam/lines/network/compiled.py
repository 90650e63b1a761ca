"""The network for reading only, in compiled numpy: no torch to load, and half its time.

The same numbers as :class:`~sl3d_slam.lines.network.model.SuperLine3D` to float32's rounding, by
one thread that holds no lock of Python's: several scans go side by side.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int64

from sl3d_slam.lines.network.answer import Inference
from sl3d_slam.lines.network.blocks import (
    cell_maxima,
    edge_block,
    heard_of_cells,
    line_probability,
    normed,
    offset_block,
)
from sl3d_slam.lines.network.cells import Cells, find_cells
from sl3d_slam.lines.network.offsets import edge_inputs
from sl3d_slam.lines.network.products import linear, packed
from sl3d_slam.lines.network.settings import LINE, NetworkSettings
from sl3d_slam.lines.network.shapes import EXCHANGES
from sl3d_slam.lines.network.weights_format import Tensors


class _Encoded(NamedTuple):
    """Features of points, and of the cells that they lie in; (K, 0) without the wide view."""

    own: Float32[np.ndarray, "M C"]
    wide: Float32[np.ndarray, "K W"]
    cell_of: Int64[np.ndarray, "M"]


class CompiledModel:
    """A network with neighbours in space, on the processor."""

    def __init__(self, settings: NetworkSettings, tensors: Tensors) -> None:
        self._settings = settings
        self._tensors = tensors
        joined = 3 * settings.width
        head, bias = tensors["segmentation.0.weight"], tensors["segmentation.0.bias"]
        self._read = _Layer(np.ascontiguousarray(head[:, :joined]), bias)
        self._told = _Layer(head[:, joined:])
        if settings.context:  # what cells pool and what the head reads, in one product
            self._read = self._layer("context.lift", self._read)
        classes, logits = tensors["segmentation.2.weight"], tensors["segmentation.2.bias"]
        self._contrast = classes[LINE] - classes[1 - LINE], float(logits[LINE] - logits[1 - LINE])
        self._blocks = [self._joint_layer(f"blocks.{b}") for b in (1, 2)]
        exchanges = range(EXCHANGES if settings.context else 0)
        self._exchanges = [self._joint_layer(f"context.exchanges.{e}", True) for e in exchanges]
        self._mixes = [self._layer(f"context.exchanges.{e}.mix") for e in exchanges]
        self._offsets = [self._layer(f"blocks.0.{part}") for part in ("first", "second")]
        self._descriptor = [self._layer(f"descriptor.{part}") for part in (0, 2)]

    def infer(
        self, points: Float32[np.ndarray, "M 4"], neighbours: Int64[np.ndarray, "M k"]
    ) -> Inference:
        """Return what the network makes of points and the neighbours that each looks at."""
        scratch = np.empty((len(points), self._blocks[0].width), np.float32)  # new pages cost time
        own = self._points(points, neighbours, scratch)
        read = self._read(own, 0, scratch[:, : self._read.width])
        cell_of, wide = np.zeros(len(own), np.int64), np.zeros((1, 0), np.float32)
        if self._settings.context:
            cells = find_cells(points[:, :3], np.zeros(len(points), np.int64))
            cell_of, wide = cells.cell_of, self._wide(read, cells)
        column = read.shape[1] // 2 if self._settings.context else 0
        probability = line_probability(read, self._told(wide), cell_of, self._contrast, column)
        return Inference(probability, partial(self._describe, _Encoded(own, wide, cell_of)))

    def _describe(
        self, encoded: _Encoded, rows: Int64[np.ndarray, "P"]
    ) -> Float32[np.ndarray, "P D"]:
        """Return the unit descriptors of some of the points."""
        joined = np.concatenate([encoded.own[rows], encoded.wide[encoded.cell_of[rows]]], axis=1)
        hidden = np.maximum(self._descriptor[0](joined), np.float32(0.0))
        values = self._descriptor[1](hidden)[:, : self._settings.descriptor_dim]
        lengths = np.sqrt(np.einsum("ij,ij->i", values, values))
        return values / np.maximum(lengths, 1e-12)[:, None]

    def _points(
        self,
        points: Float32[np.ndarray, "M 4"],
        neighbours: Int64[np.ndarray, "M k"],
        scratch: Float32[np.ndarray, "M W"],
    ) -> Float32[np.ndarray, "M C"]:
        """Return the three blocks' features, side by side."""
        width = self._settings.width
        own = np.empty((len(points), 3 * width), np.float32)
        inputs = edge_inputs(points, neighbours, self._settings)
        first, second = (layer.packed for layer in self._offsets)
        offset_block(inputs, first, second, self._norm("blocks.0.norm"), own)
        for number, layer in enumerate(self._blocks, 1):
            products = layer(own, (number - 1) * width, scratch)
            norm = self._norm(f"blocks.{number}.norm")
            edge_block(products, neighbours, norm, own, number * width)
        return own

    def _wide(self, lifted: Float32[np.ndarray, "M _"], cells: Cells) -> np.ndarray:
        """Return what each cell has learned of the surroundings (K, W)."""
        pooled = cell_maxima(lifted, self._settings.width, cells.cell_of, len(cells.gaps[0]))
        for number, (neighbours, gaps) in enumerate(zip(cells.neighbours, cells.gaps, strict=True)):
            name = f"context.exchanges.{number}"
            gap_weight = self._tensors[f"{name}.gap.weight"].T.copy()
            products = self._exchanges[number](pooled)
            heard = heard_of_cells(products, neighbours, gaps, gap_weight)
            pooled = pooled + normed(self._mixes[number](heard), self._norm(f"{name}.norm"))
        return pooled

    def _layer(self, name: str, second: "_Layer | None" = None) -> "_Layer":
        return _Layer(self._tensors[f"{name}.weight"], self._tensors[f"{name}.bias"], second)

    def _joint_layer(self, name: str, plain: bool = False) -> "_Layer":
        """Return both products of an EdgeConv in one; ``plain`` where edges are no differences."""
        centre, edge = self._tensors[f"{name}.centre.weight"], self._tensors[f"{name}.edge.weight"]
        bias = self._tensors[f"{name}.centre.bias"]
        own = centre if plain else centre - edge
        return _Layer(own, bias, _Layer(edge))

    def _norm(self, name: str) -> Float32[np.ndarray, "2 W"]:
        return np.stack([self._tensors[f"{name}.weight"], self._tensors[f"{name}.bias"]])


class _Layer:
    """A linear layer, its weight packed once; another may follow in the same product."""

    def __init__(
        self,
        weight: Float32[np.ndarray, "D C"],
        bias: Float32[np.ndarray, "D"] | None = None,
        second: "_Layer | None" = None,
    ) -> None:
        bias = np.zeros(len(weight), np.float32) if bias is None else bias
        tiles, filled = packed(weight, bias)
        if second is not None:
            tiles = np.concatenate([tiles, second.packed[0]])
            filled = np.concatenate([filled, second.packed[1]])
        self.packed: tuple[np.ndarray, np.ndarray] = (tiles, filled)
        self.width = len(filled)

    def __call__(
        self,
        features: Float32[np.ndarray, "M _"],
        column: int = 0,
        result: Float32[np.ndarray, "M W"] | None = None,
    ) -> Float32[np.ndarray, "M W"]:
        """Return the values for the features from a column on, filled up with zeros to whole tiles.

        They are written to ``result`` where that is given.
        """
        values = np.empty((len(features), self.width), np.float32) if result is None else result
        linear(features, column, self.packed, values)
        return values
