"""Synthetic clouds and the training on them: sizes, seeds, kinds, scale."""

import numpy as np
import pytest
import torch

from sl3d_slam.errors import InputError
from sl3d_slam.learning.background import clips_of_scans, cut_clips
from sl3d_slam.learning.primitives import distances_to_segments_m
from sl3d_slam.learning.scan_rings import ScanRings
from sl3d_slam.learning.segmentation import (
    Agreement,
    Sample,
    kind_weights,
    line_shares,
    segmentation_loss,
)
from sl3d_slam.learning.segmentation_trainer import FitSettings, fit
from sl3d_slam.learning.synthetic import SyntheticSettings, perturbed, synthetic_cloud
from sl3d_slam.learning.synthetic_training import (
    SyntheticRun,
    scale_invariant,
    synthetic_samples,
    train_synthetic,
)
from sl3d_slam.lines.network.model import SuperLine3D
from sl3d_slam.lines.network.weights_file import load_weights
from sl3d_slam.types import LineKind

SMALL = SyntheticSettings(primitive_points=400, background_points=100)


@pytest.fixture(scope="module")
def clips():
    rng = np.random.default_rng(3)
    return tuple(rng.normal(0, [3, 3, 0.5], (1000, 3)) for _ in range(4))


def tiny_run(**changes):
    network = scale_invariant(width=8, num_neighbours=8)
    return SyntheticRun(**{"clouds": 12, "epochs": 1, "batch": 2, "shapes": SMALL,
                           "network": network, **changes})  # fmt: skip


def test_a_cloud_has_the_papers_make_up(clips):
    cloud = synthetic_cloud(0, 0, clips)
    assert cloud.points.shape == (5000, 3)
    assert cloud.points.min() >= 0
    assert cloud.points.max() <= 1
    assert np.ptp(cloud.points, axis=0).max() == pytest.approx(1.0, abs=1e-6)  # float32


@pytest.mark.parametrize("scanned", [0.0, 1.0])
def test_every_cloud_has_all_its_points_however_it_is_sampled(scanned, clips):
    shapes = SyntheticSettings(
        primitive_points=400, background_points=100, max_primitives=1, scanned=scanned
    )
    assert {len(synthetic_cloud(3, k, clips, shapes).points) for k in range(60)} == {500}


def test_a_cloud_is_the_same_again_and_every_seed_another(clips):
    first, again = (synthetic_cloud(7, 123, clips, SMALL) for _ in range(2))
    np.testing.assert_array_equal(first.points, again.points)
    np.testing.assert_array_equal(first.line_id, again.line_id)
    seeds = {synthetic_cloud(seed, 0, clips, SMALL).points.tobytes() for seed in range(150)}
    assert len(seeds) == 150  # the authors' code had 100


def test_rings_on_a_wall_lie_as_far_apart_as_the_sensor_turns_between_them(rng):
    rings = ScanRings(np.array([2.0, -3.0, 1.7]), np.radians(1.2))
    wall = np.c_[np.full(40_000, 22.0), np.full(40_000, -3.0), rng.uniform(-1.0, 4.0, 40_000)]
    z = np.sort(wall[rings.hit(wall), 2])
    starts = z[np.flatnonzero(np.diff(z) > 0.1) + 1]
    assert len(starts) >= 9  # 5 m of wall, a ring each 0.42 m
    # 20 m away straight ahead; near the horizon tan(1.2 deg) holds to 1 %
    np.testing.assert_allclose(np.diff(starts), 20 * np.tan(np.radians(1.2)), rtol=0.03)


def test_scanned_clouds_are_labelled_by_the_same_geometry(clips):
    scanned = SyntheticSettings(
        primitive_points=2000, background_points=0, perturbation=0.0, scanned=1.0, max_primitives=2
    )
    cloud = synthetic_cloud(1, 5, (), scanned)
    assert len(cloud.points) == 2000
    distance = distances_to_segments_m(cloud.points.astype(float), cloud.endpoints.astype(float))
    on_line = cloud.line_id >= 0
    assert on_line.any()
    own = distance[np.flatnonzero(on_line), cloud.line_id[on_line]]
    assert np.median(own) < np.median(distance[~on_line].min(axis=1))


def test_perturbation_is_five_percent_of_the_size(rng):
    shift = perturbed(np.zeros((20_000, 3)), 8.0, 0.05, rng)
    assert np.abs(shift).max() <= 0.4
    assert np.abs(shift).max() > 0.399  # of 60,000 even draws the largest misses by 1e-5
    # an even spread of half width a has a / sqrt(3); 60,000 draws tell it to 1 %
    assert shift.std() == pytest.approx(0.4 / np.sqrt(3), rel=0.01)


def test_labels_stay_near_their_true_line_after_scaling_and_shuffling(clips):
    exact = SyntheticSettings(primitive_points=2000, background_points=100, perturbation=0.0)
    cloud = synthetic_cloud(1, 5, clips, exact)
    on_line = cloud.line_id >= 0
    points = cloud.points[on_line].astype(float)
    distance = distances_to_segments_m(points, cloud.endpoints.astype(float))
    own = distance[np.arange(len(points)), cloud.line_id[on_line]]
    assert own.max() < 0.06  # the reach of a label is a mean spacing, at most a twentieth here


def test_poles_and_edges_are_both_there_and_weigh_the_same(clips):
    kinds = [synthetic_cloud(0, index, clips, SMALL).kinds for index in range(30)]
    weights = kind_weights(kinds)
    count = np.bincount(np.concatenate(kinds), minlength=4)
    assert (count > 0).all()
    shares = weights * count / count.sum()
    expected = [0.5, 1 / 6, 1 / 6, 1 / 6]
    np.testing.assert_allclose(shares, expected, rtol=1e-5)  # float32
    assert count[LineKind.POLE] * 3 < count.sum()  # they are few, yet count as much


def test_a_missed_pole_costs_as_much_as_a_missed_edge():
    kinds = np.array([0] * 90 + [LineKind.POLE] * 2 + [LineKind.VERTICAL_EDGE] * 8, np.uint8)
    weights = kind_weights([kinds])
    sample = Sample(np.zeros((100, 3), np.float32), kinds > 0, weights[kinds])
    losses = {}
    for kind in (LineKind.POLE, LineKind.VERTICAL_EDGE):
        right = torch.from_numpy(np.where(kinds > 0, 4.0, -4.0).astype(np.float32))
        right[torch.from_numpy(kinds == kind)] = -4.0
        losses[kind] = float(segmentation_loss(torch.stack([-right, right], dim=1), [sample]))
    assert losses[LineKind.POLE] == pytest.approx(losses[LineKind.VERTICAL_EDGE], rel=1e-4)
    assert losses[LineKind.POLE] > 1.0


def test_points_of_unknown_truth_do_not_count():
    weights = np.ones(50, np.float32)
    weights[20:] = 0
    sample = Sample(np.zeros((50, 3), np.float32), np.zeros(50, bool), weights)
    logits = torch.zeros(50, 2)
    logits[20:, 1] = 100.0  # utterly wrong, but nobody knows
    assert float(segmentation_loss(logits, [sample])) == pytest.approx(np.log(2), rel=1e-5)


@pytest.mark.parametrize("scale", [0.1, 0.37, 3.0])
def test_the_answer_does_not_depend_on_the_scale(clips, scale):
    torch.manual_seed(1)
    network = SuperLine3D(scale_invariant(width=16, num_neighbours=10)).eval()
    cloud = synthetic_cloud(0, 3, clips, SMALL).points
    (here,), (there,) = (line_shares(network, [points], 10, 4) for points in (cloud, cloud * scale))
    np.testing.assert_allclose(there, here, atol=1e-4)  # float32 offsets, rounded differently
    assert np.ptp(here) > 1e-3  # it does say different things of different points


def test_agreement_by_hand():
    found, truth = np.array([1, 1, 0, 0, 0], bool), np.array([1, 0, 1, 0, 0], bool)
    agreement = Agreement().plus(found, truth)
    assert agreement.accuracy == pytest.approx(3 / 5)
    assert agreement.mean_iou == pytest.approx(0.5 * (1 / 3 + 2 / 4))
    assert (agreement.precision, agreement.recall) == (0.5, 0.5)


def test_a_stopped_run_ends_in_the_same_weights(clips, tmp_path):
    run = tiny_run()
    settings = FitSettings(steps=6, num_neighbours=8, checkpoint_every=2)
    samples_of = synthetic_samples(run, clips)

    class StoppedError(Exception):
        pass

    def stop_at_five(note, steps):
        done.append(steps)
        if len(done) == 5:
            raise StoppedError

    networks, done = [], []
    for _ in range(3):
        torch.manual_seed(0)
        networks.append(SuperLine3D(run.network))
    whole, stopped, resumed = networks
    fit(whole, samples_of, settings)
    with pytest.raises(StoppedError):
        fit(stopped, samples_of, settings, tmp_path / "c.safetensors", stop_at_five)
    losses = fit(resumed, samples_of, settings, tmp_path / "c.safetensors")
    assert len(losses) == 2  # from the checkpoint after step 4
    for a, b in zip(whole.parameters(), resumed.parameters(), strict=True):
        assert torch.equal(a, b)


def test_training_leaves_weights_and_figures(clips, tmp_path):
    figures = train_synthetic(tiny_run(clouds=4), clips, tmp_path)
    assert set(figures) == {"accuracy", "mean_iou", "precision", "pole_recall", "edge_recall"}
    assert load_weights(tmp_path / "weights.safetensors").settings.scale_invariant


def test_a_foreign_checkpoint_is_refused_in_a_sentence(clips, tmp_path):
    train_synthetic(tiny_run(clouds=2), clips, tmp_path)
    with pytest.raises(InputError, match="made with other settings"):
        train_synthetic(tiny_run(clouds=4), clips, tmp_path)
    (tmp_path / "checkpoint.safetensors").write_bytes(b"not weights")
    with pytest.raises(InputError, match=r"checkpoint\.safetensors: missing or damaged"):
        train_synthetic(tiny_run(clouds=2), clips, tmp_path)


def test_clips_hold_no_line(rng):
    points = rng.uniform([-30, -30, 0], [30, 30, 6], (40_000, 3))
    on_line = np.where(np.abs(points[:, 0] - 10) < 1.5, 0, -1)
    clips = cut_clips([(points, on_line)], rng)
    assert len(clips) == 40
    assert {len(clip) for clip in clips} == {1000}
    np.testing.assert_allclose([clip.mean(axis=0) for clip in clips], 0.0, atol=1e-9)


def test_a_scan_too_small_for_a_clip_is_named():
    with pytest.raises(InputError, match="background: no place with 1000 points"):
        clips_of_scans([np.ones((300, 3))], 0)


@pytest.mark.slow
def test_two_minutes_of_training_find_poles_and_edges(clips, tmp_path):
    network = scale_invariant(width=32, num_neighbours=16)
    shapes = SyntheticSettings(primitive_points=2000, background_points=500)
    run = tiny_run(clouds=400, learning_rate=3e-3, shapes=shapes, network=network)
    figures = train_synthetic(run, clips, tmp_path)
    assert figures["accuracy"] > 0.6  # chance at these recalls would be below
    assert figures["pole_recall"] > 0.5
    assert figures["edge_recall"] > 0.5
