"""The joint training: what it is shown, that it learns, and that a killed run is not felt."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sl3d_slam.errors import InputError, OutputError
from sl3d_slam.geometry.se3 import from_yaw, invert, make_transform, transform_points
from sl3d_slam.geometry.segments import transform_segments
from sl3d_slam.learning.augment import augment
from sl3d_slam.learning.joint import COLUMNS, JointTraining, read_curves
from sl3d_slam.learning.joint_run import (
    JointPlan,
    look_at_drive,
    read_looks,
    train_joint,
    write_looks,
)
from sl3d_slam.learning.joint_settings import AugmentSettings, JointSettings
from sl3d_slam.learning.joint_validation import detect, rank
from sl3d_slam.learning.pair_source import PairSource
from sl3d_slam.learning.pairs import close_pairs, draw_pair, same_lines
from sl3d_slam.learning.parallel import Team
from sl3d_slam.learning.prepared import PreparedDrive, PreparedScan, load_drive, save_drive
from sl3d_slam.lines.network.model import SuperLine3D
from sl3d_slam.lines.network.settings import NetworkSettings
from sl3d_slam.lines.network.weights_file import load_weights

SMALL = NetworkSettings(width=8, descriptor_dim=8, num_neighbours=6, stride=1)
T_WORLD_SCANS = np.stack([from_yaw(0.4 * k, np.array([2.0 * k, 0.5 * k, 0.1])) for k in range(6)])


def upright(x, y, low=0.0, high=4.0):
    return np.array([[x, y, low], [x, y, high]])


@pytest.fixture
def drive(rng):
    """Six scans among twelve poles of different heights and some shrubs; 2 m from scan to scan."""
    places = rng.uniform(-15, 15, (12, 2))
    world = np.array([upright(x, y, 0.0, 2.0 + 0.4 * k) for k, (x, y) in enumerate(places)])
    shrubs = rng.uniform([-15, -15, 0], [15, 15, 1.5], (300, 3))
    scans = []
    for T_world_lidar in T_WORLD_SCANS:
        poles = [line[0] + rng.uniform(0, 1, (20, 1)) * (line[1] - line[0]) for line in world]
        points_world = np.concatenate([*poles, shrubs]) + rng.normal(0, 0.02, (540, 3))
        points = transform_points(invert(T_world_lidar), points_world)
        ids = np.r_[np.repeat(np.arange(12), 20), np.full(300, -1)].astype(np.int32)
        scans.append(
            PreparedScan(
                np.c_[points, points_world[:, 2]].astype(np.float32),
                ids,
                transform_segments(invert(T_world_lidar), world).astype(np.float32),
                np.ones(12, np.uint8),
            )
        )
    return PreparedDrive("poles", True, T_WORLD_SCANS, tuple(scans))


def settings(**changes):
    return JointSettings(steps=6, points=600, warmup_steps=2, **changes)


def new_model(seed=0):
    torch.manual_seed(seed)
    return SuperLine3D(SMALL)


def weights_of(model):
    return {name: value.clone() for name, value in model.state_dict().items()}


def test_a_killed_run_resumed_ends_in_the_same_weights(drive, tmp_path):
    whole = JointTraining(new_model(), [drive], settings(), tmp_path / "whole")
    whole.run(checkpoint_every=2)
    killed = JointTraining(new_model(), [drive], settings(), tmp_path / "killed")
    killed.run(checkpoint_every=2, stop=3)
    resumed = JointTraining(new_model(seed=9), [drive], settings(), tmp_path / "killed")
    resumed.resume()
    assert resumed.step == 3
    resumed.run(checkpoint_every=2)
    expected = weights_of(whole.model)
    assert all(torch.equal(v, expected[n]) for n, v in weights_of(resumed.model).items())
    curves = [(tmp_path / name / "curves.csv").read_text() for name in ("whole", "killed")]
    assert curves[0] == curves[1]
    assert [row[0] for row in read_curves(tmp_path / "whole" / "curves.csv")] == [1, 2, 3, 4, 5, 6]


def test_every_step_sees_pairs_of_its_own_and_every_process_too(drive, tmp_path, monkeypatch):
    drawn = []
    draw = PairSource.draw

    def noted(source, number):
        drawn.append(number)
        return draw(source, number)

    monkeypatch.setattr(PairSource, "draw", noted)
    JointTraining(new_model(), [drive], settings(pairs_per_step=2), tmp_path / "a").run(stop=3)
    assert drawn == [0, 1, 2, 3, 4, 5]
    drawn.clear()
    second = JointTraining(
        new_model(), [drive], settings(pairs_per_step=2), tmp_path / "b", Team(rank=1, size=3)
    )
    monkeypatch.setattr(Team, "average_gradients", lambda team, model: None)
    monkeypatch.setattr(Team, "average", lambda team, values: values)
    second.run(stop=2)
    assert drawn == [2, 3, 8, 9]


def test_weights_left_by_a_run_are_those_of_the_model(drive, tmp_path):
    training = JointTraining(new_model(), [drive], settings(), tmp_path)
    training.run()
    expected = weights_of(training.model)
    loaded = weights_of(load_weights(tmp_path / "weights.safetensors"))
    assert all(torch.equal(value, expected[name]) for name, value in loaded.items())


@pytest.mark.parametrize("changes", [{"seed": 1}, {"learning_rate": 1e-2}])
def test_a_checkpoint_of_other_settings_is_refused(drive, tmp_path, changes):
    JointTraining(new_model(), [drive], settings(), tmp_path).run(stop=1)
    other = JointTraining(new_model(), [drive], settings(**changes), tmp_path)
    with pytest.raises(InputError, match=r"checkpoint\.safetensors: made with other settings"):
        other.resume()


@pytest.mark.parametrize("damage", [lambda raw: raw[:-9], lambda raw: b"", lambda raw: b"x" * 99])
def test_a_damaged_checkpoint_is_refused(drive, tmp_path, damage):
    JointTraining(new_model(), [drive], settings(), tmp_path).run(stop=1)
    file = tmp_path / "checkpoint.safetensors"
    file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(InputError, match=r"checkpoint\.safetensors: missing or damaged"):
        JointTraining(new_model(), [drive], settings(), tmp_path).resume()


def test_the_loss_falls_and_partners_are_found(drive, tmp_path):
    longer = JointSettings(steps=60, points=600, warmup_steps=5, learning_rate=5e-3)
    training = JointTraining(new_model(), [drive], longer, tmp_path)
    training.run()
    rows = np.array(read_curves(tmp_path / "curves.csv"))
    assert rows.shape == (60, len(COLUMNS))
    assert rows[-10:, 2].mean() < 0.8 * rows[:10, 2].mean()
    near = rank(training.model, drive)[0]
    assert near.num_lines == 12 * near.num_pairs > 0
    assert near.chance_five == pytest.approx(5 / 12)
    assert near.top_five > near.chance_five + 0.1
    assert detect(training.model, drive, every=1).best_f1 > 0.75  # all points are lines: 0.62


def test_other_seeds_show_other_pairs_and_none_stops_at_a_hundred(drive):
    """The authors' code had a hundred seeds, and read only the first hundred pairs."""
    long_drive = PreparedDrive(
        "long",
        True,
        np.stack([from_yaw(0.0, np.array([0.5 * k, 0.0, 0.0])) for k in range(40)]),
        tuple(drive.scans[k % 6] for k in range(40)),
    )
    source = PairSource([long_drive], JointSettings(points=600), SMALL)
    assert source.num_pairs == 40 * 39 // 2
    rng = np.random.default_rng(5)
    pairs = close_pairs(long_drive.T_world_lidar, 30.0)
    gaps = np.abs(pairs[:, 0] - pairs[:, 1]) * 0.5
    drawn = {tuple(sorted(draw_pair(pairs, gaps, rng.uniform(0, 20), rng))) for _ in range(9000)}
    assert len(drawn) > 700  # of 780; the rarest come up with chance 1/40 x 1/39 a draw
    shown = [
        PairSource([drive], settings(seed=seed), SMALL).draw(0).points.numpy().tobytes()
        for seed in range(98, 104)
    ]
    assert len(set(shown)) == 6


def test_a_pair_is_the_same_whenever_it_is_drawn(drive):
    first, again = (PairSource([drive], settings(), SMALL) for _ in range(2))
    first.draw(3)
    assert torch.equal(first.draw(7).points, again.draw(7).points)
    assert torch.equal(first.draw(7).matches, again.draw(7).matches)


def test_matches_of_a_pair_are_the_same_poles(drive):
    """Rows of this drive's lines are the same in all scans, whichever way a pair is turned."""
    source = PairSource([drive], settings(), SMALL)
    for number in range(8):
        assert source.draw(number).matches.tolist() == [[k, k] for k in range(12)]


def test_real_and_simulated_drives_come_up_in_the_wanted_share(drive):
    real = replace(drive, simulated=False, scans=tuple(map(replace, drive.scans)))
    source = PairSource([drive, drive, drive, real], settings(real_share=0.5), SMALL)
    rng, known = np.random.default_rng(0), {id(scan) for scan in real.scans}
    drawn = [id(source._draw_pair(rng)[0][0]) in known for _ in range(1000)]
    assert np.mean(drawn) == pytest.approx(0.5, abs=0.06)  # four sigma


def test_matches_hold_under_the_relative_pose_and_not_its_inverse():
    T_a_b = make_transform(from_yaw(0.8, np.zeros(3))[:3, :3], np.array([7.0, -3.0, 0.4]))
    target = np.array([upright(5, 5), upright(-4, 9), upright(2, -7)])
    source = transform_segments(invert(T_a_b), target[[2, 0]])
    source[0, :, 0] += 0.1
    assert same_lines(target, source, T_a_b, 0.2).tolist() == [[0, 1], [2, 0]]
    assert len(same_lines(target, source, invert(T_a_b), 0.2)) == 0


@pytest.mark.parametrize(
    ("other", "same"),
    [
        (upright(0.15, 0.0), True),
        (upright(0.25, 0.0), False),  # farther than 0.2 m
        (upright(0.0, 0.0, 3.0, 6.0), True),  # another part of the same line
        (upright(0.0, 0.0, 6.0, 9.0), False),  # above it, apart
        (np.array([[-2.0, 0.0, 2.0], [2.0, 0.0, 2.0]]), False),  # crossing
        (upright(0.0, 0.0)[::-1], True),  # end points have no order
    ],
)
def test_what_counts_as_the_same_line(other, same):
    matches = same_lines(np.array([upright(0, 0)]), other[None], np.eye(4), 0.2)
    assert len(matches) == int(same)


def test_augmentation_moves_lines_with_their_points(drive, rng):
    scan = drive.scans[2]
    calm = AugmentSettings(noise_m=0.0, max_thinning=0.0, beam_share=0.0, max_tilt_deg=10.0)
    for mirrored in (False, True):
        changed = augment(scan, calm, 10_000, mirrored, rng)
        np.testing.assert_array_equal(changed.line_ids, scan.line_ids)
        low, high = changed.endpoints[:, 0], changed.endpoints[:, 1]
        along = (high - low) / np.linalg.norm(high - low, axis=1, keepdims=True)
        for line in range(12):
            members = changed.points[changed.line_ids == line, :3] - low[line]
            across = members - (members @ along[line])[:, None] * along[line]
            assert np.linalg.norm(across, axis=1).max() < 0.12  # the scan's own noise, 0.02 m
        lean = np.degrees(np.arccos(np.abs(along[:, 2]).min()))
        assert 0.0 < lean <= 10.0 + 1e-3


def test_augmentation_thins_what_is_far(rng):
    near, far = (np.tile([r, 0.0, 1.0, 1.0], (4000, 1)).astype(np.float32) for r in (5.0, 45.0))
    scan = PreparedScan(
        np.concatenate([near, far]),
        np.full(8000, -1, np.int32),
        np.zeros((0, 2, 3), np.float32),
        np.zeros(0, np.uint8),
    )
    thin = AugmentSettings(noise_m=0.0, max_thinning=0.9, beam_share=0.0, max_tilt_deg=0.0)
    kept = [augment(scan, thin, 10_000, False, rng).points[:, :2] for _ in range(10)]
    ranges = np.concatenate([np.linalg.norm(points, axis=1) for points in kept])
    assert (ranges > 30).sum() < 0.8 * (ranges < 30).sum()


def test_prepared_drives_come_back_whole_and_damage_is_named(drive, tmp_path):
    file = tmp_path / "poles.safetensors"
    save_drive(file, drive, "made of poles")
    assert load_drive(file, "made of something else") is None
    again = load_drive(file, "made of poles")
    assert again is not None
    assert (again.name, again.simulated) == ("poles", True)
    for one, other in zip(again.scans, drive.scans, strict=True):
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_array_equal(one.line_ids, other.line_ids)
        np.testing.assert_array_equal(one.endpoints, other.endpoints)
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(InputError, match=r"poles\.safetensors: damaged"):
        load_drive(file, "made of poles")


def test_looks_of_an_earlier_part_of_a_run_are_kept(drive, tmp_path):
    model = new_model()
    looks = [look_at_drive(model, drive, step) for step in (100, 200)]
    write_looks(tmp_path / "validation.csv", looks)
    kept = read_looks(tmp_path / "validation.csv", last_step=150)
    assert [(look.step, look.drive) for look in kept] == [(100, "poles")]
    assert kept[0].best_f1 == pytest.approx(looks[0].best_f1, abs=1e-4)
    assert read_looks(tmp_path / "none.csv", 10) == []
    (tmp_path / "validation.csv").write_text("step,drive\nx,y\n")
    with pytest.raises(InputError, match=r"validation\.csv: expected"):
        read_looks(tmp_path / "validation.csv", 10)


def test_a_file_where_results_should_go_is_found_out_before_any_drive_is_read(tmp_path):
    file = tmp_path / "file"
    file.write_text("precious")
    for plan in (
        JointPlan((tmp_path / "no drive",), file),
        JointPlan((tmp_path / "no drive",), tmp_path / "run", cache=file),
    ):
        with pytest.raises(OutputError, match="file: is a file; expected a folder"):
            train_joint(plan, JointSettings(), SMALL)
    assert file.read_text() == "precious"
