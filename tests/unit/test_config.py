"""Settings: every file in configs/ loads, default.yaml is the code, a typo is named."""

import pytest
import yaml

from sl3d_slam.config import SlamConfig, dump_config, load_config
from sl3d_slam.errors import ConfigError

CONFIGS = ("default", "kitti", "hdl32", "handheld", "smoke")


def flat(tree, prefix=""):
    leaves = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            leaves |= flat(value, f"{prefix}{key}.")
        else:
            leaves[prefix + key] = value
    return leaves


def test_default_yaml_lists_every_setting_with_the_value_in_the_code(repository):
    in_file = flat(yaml.safe_load((repository / "configs" / "default.yaml").read_text()))
    in_code = flat(SlamConfig().model_dump())
    assert sorted(in_file.keys() ^ in_code.keys()) == [], "keys in only one of file and code"
    differing = {
        key: (in_file[key], in_code[key]) for key in in_file if in_file[key] != in_code[key]
    }
    assert differing == {}, "(in default.yaml, in the code)"


def test_no_config_is_untested(repository):
    assert {path.stem for path in (repository / "configs").iterdir()} == set(CONFIGS)


@pytest.mark.parametrize("name", CONFIGS)
def test_config_loads_and_starts_with_the_command_that_uses_it(repository, name):
    path = repository / "configs" / f"{name}.yaml"
    load_config(path)
    first_line = path.read_text().splitlines()[0]
    assert first_line.startswith("# sl3d ")
    assert name == "default" or f"--config configs/{name}.yaml" in first_line


@pytest.mark.parametrize("name", [name for name in CONFIGS if name != "default"])
def test_config_lists_only_what_differs(repository, name):
    listed = flat(yaml.safe_load((repository / "configs" / f"{name}.yaml").read_text()))
    defaults = flat(SlamConfig().model_dump())
    assert [key for key, value in listed.items() if defaults[key] == value] == []


def test_dump_reads_back_to_the_same_settings(tmp_path):
    config = load_config(overrides=["seed=7", "input.kitti_correction='off'", "map.clouds=false"])
    path = tmp_path / "config.yaml"
    path.write_text(dump_config(config))
    assert load_config(path) == config
    assert load_config(path) != SlamConfig()


def test_override_wins_over_the_file(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text("keyframes:\n  min_distance_m: 9\n  min_rotation_deg: 33\n")
    config = load_config(path, ["keyframes.min_distance_m=4.5"])
    assert config.keyframes.min_distance_m == 4.5
    assert config.keyframes.min_rotation_deg == 33.0


def test_a_section_whose_keys_are_all_commented_out_changes_nothing(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text("input:\n#  deskew: false\n")
    assert load_config(path) == SlamConfig()


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        (
            "input.max_rnge_m=60",
            "input.max_rnge_m is not a setting; did you mean input.max_range_m?",
        ),
        ("min_rotation_deg=1", "did you mean keyframes.min_rotation_deg?"),
        ("keyframe.min_distance_m=1", "keyframe is not a setting; did you mean keyframes?"),
        ("zebra=1", "zebra is not a setting"),
        ("input.max_range_m=abc", "input.max_range_m: .* found 'abc'"),
        ("input.max_range_m=.inf", "input.max_range_m: .*finite"),
        ("input.max_range_m=1", "input: min_range_m must be below max_range_m"),
        ("keyframes.min_distance_m=-2", "keyframes.min_distance_m: .*greater than 0, found -2"),
        ("input=3", "input is a section"),
        ("seed.x=3", "seed"),
        ("seed", "--set seed: expected section.key=value"),
        ("=3", "expected section.key=value"),
        ("seed=[1", "not valid YAML"),
        ("seed=2020-13-45", "not valid YAML"),
    ],
)
def test_wrong_override_is_explained(override, expected):
    with pytest.raises(ConfigError, match=expected) as caught:
        load_config(overrides=[override])
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("--set")


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"input:\n  max_rnge_m: 60\n", "input.max_rnge_m is not a setting"),
        (b"- 1\n- 2\n", "expected sections with keys, found a list"),
        (b"a: [\n", "not valid YAML"),
        (b"\xff\xfe\x00", "not valid YAML"),
        (b"[" * 5_000, "not valid YAML"),
        (b"x" * 1_000_001, "larger than"),
        (b"1: 2\n", "1: "),
    ],
)
def test_wrong_file_is_named(tmp_path, content, expected):
    path = tmp_path / "broken.yaml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=expected) as caught:
        load_config(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_repeated_aliases_do_not_fill_the_sentence(tmp_path):
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 9)]
    path = tmp_path / "bomb.yaml"
    path.write_text("\n".join([*lines, "seed: *a8"]))
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert len(str(caught.value)) < 500


def test_missing_file_and_folder_are_named(tmp_path):
    for path in (tmp_path / "nowhere.yaml", tmp_path):
        with pytest.raises(ConfigError, match="cannot be read as a settings file"):
            load_config(path)
