"""The scale sweep: its networks can be trained, and its figures say what they should."""

import numpy as np
import pytest
import torch

from sl3d_slam.bench import scale
from sl3d_slam.bench.scale import OURS, SCALES, Extent, measure, run
from sl3d_slam.learning.baselines import Dgcnn, PointNet, PointNet2, farthest_points
from sl3d_slam.learning.segmentation import line_shares, make_batch

TINY = Extent(clouds=4, epochs=1, points=250, test_clouds=2, width=8, neighbours=6)
NETWORKS = {"PointNet": PointNet, "PointNet++": PointNet2, "DGCNN": lambda w: Dgcnn(w, 6)}


@pytest.mark.parametrize("name", NETWORKS)
def test_clouds_of_a_batch_do_not_see_each_other(name, rng):
    torch.manual_seed(0)
    network = NETWORKS[name](8).eval()
    clouds = [rng.random((n, 3)).astype(np.float32) for n in (120, 200)]
    together = line_shares(network, clouds, 6, 1)
    alone = [line_shares(network, [cloud], 6, 1)[0] for cloud in clouds]
    for a, b in zip(together, alone, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)  # float32 sums in another order


@pytest.mark.parametrize("name", NETWORKS)
def test_every_weight_learns(name, rng):
    torch.manual_seed(0)
    network = NETWORKS[name](8)
    batch = make_batch([rng.random((150, 3)).astype(np.float32)], 6, 1)
    logits = network(batch.points, batch.neighbours, batch.sizes)[0]
    logits.square().sum().backward()
    for parameter_name, parameter in network.named_parameters():
        if not parameter_name.endswith("0.bias"):  # batch norm takes a bias before it away
            assert parameter.grad is not None
            assert parameter.grad.abs().sum() > 0, parameter_name


def test_order_of_points_does_not_matter_to_dgcnn(rng):
    torch.manual_seed(0)
    network = Dgcnn(8, 6).eval()
    cloud, order = rng.random((100, 3)).astype(np.float32), rng.permutation(100)
    (here,), (there,) = (line_shares(network, [c], 6, 1) for c in (cloud, cloud[order]))
    np.testing.assert_allclose(there, here[order], atol=1e-5)


def test_farthest_points_spread_over_the_cloud():
    cloud = np.c_[np.linspace(0, 1, 101), np.zeros((101, 2))]
    chosen = np.sort(farthest_points(cloud, 5)[:, 0])
    np.testing.assert_allclose(chosen, [0, 0.25, 0.5, 0.75, 1.0])
    assert len(farthest_points(cloud[:3], 5)) == 3


def test_tables_and_pictures_of_a_small_sweep(tmp_path, monkeypatch):
    monkeypatch.setattr(scale, "QUICK", TINY)
    steps = []
    tables = run(tmp_path, quick=True, progress=lambda note, n: steps.append(n))
    assert sum(steps) == scale.num_steps(quick=True) == 4
    assert {path.name for path in tmp_path.iterdir()} == {
        "scale.csv", "scale_2.csv", "scale.md", "scale.png", "scale_table.png",
    }  # fmt: skip
    assert [row["method"] for row in tables[0].rows] == ["PointNet", "PointNet++", "DGCNN", OURS]
    ours = [tables[1].rows[3][f"{s:g}"] for s in SCALES]
    assert np.ptp(ours) < 0.01  # scaling changes nothing but the last bits


@pytest.mark.slow
def test_ours_keeps_its_figure_over_scale_and_dgcnn_does_not():
    extent = Extent(clouds=240, epochs=1, points=600, test_clouds=6, width=16, neighbours=12)
    rows = measure(extent, 0, lambda note, n: None)
    ious = {m: [r.mean_iou for r in rows if r.method == m] for m in ("DGCNN", OURS)}
    assert np.ptp(ious[OURS]) < 0.01
    assert np.ptp(ious["DGCNN"]) > 0.05
