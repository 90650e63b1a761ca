"""Every setting of a run, strict: an unknown key is an error that names it."""

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from sl3d_slam.errors import ConfigError

MAX_CONFIG_BYTES = 1_000_000
THRESHOLDS = {"min_log_odds", "min_inliers", "min_overlap"}  # those of a match that uses differ in


class Settings(BaseModel):
    """Base class: an unknown key is an error and values never change after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class InputSettings(Settings):
    """How scans are read."""

    min_range_m: float = Field(default=2.0, ge=0)
    max_range_m: float = Field(default=100.0, gt=0)
    kitti_correction: Literal["auto", "on", "off"] = "auto"
    deskew: bool = True

    @model_validator(mode="after")
    def _ordered(self) -> "InputSettings":
        if self.min_range_m >= self.max_range_m:
            raise ValueError("min_range_m must be below max_range_m")
        return self


class OdometrySettings(Settings):
    """KISS-ICP."""

    voxel_size_m: float = Field(default=1.0, gt=0)
    max_points_per_voxel: int = Field(default=20, ge=1)
    refine_on_surfaces: bool = True


class KeyframeSettings(Settings):
    """When a new keyframe starts."""

    min_distance_m: float = Field(default=3.0, gt=0)
    min_rotation_deg: float = Field(default=20.0, gt=0)


class LineSettings(Settings):
    """How lines are found in one scan; ``weights`` is a file, or None for the shipped ones."""

    method: Literal["learned", "geometric"] = "learned"
    weights: str | None = None
    voxel_size_m: float = Field(default=0.15, gt=0)
    max_range_m: float = Field(default=60.0, gt=0)
    grow_radius_m: float = Field(default=0.5, gt=0)
    min_length_m: float = Field(default=0.8, gt=0)
    max_lines: int = Field(default=80, ge=1)


class MatchingSettings(Settings):
    """How two line sets are brought together and the answer judged.

    ``min_log_odds`` and ``min_overlap`` are those of two scans, where every pose was compared with
    its rivals; loops and saved maps have their own.
    """

    distance_tolerance_m: float = Field(default=0.4, gt=0)
    angle_tolerance_deg: float = Field(default=6.0, gt=0)
    inlier_distance_m: float = Field(default=0.6, gt=0)
    min_inliers: int = Field(default=3, ge=2)
    max_hypotheses: int = Field(default=3000, ge=1)
    cloud_voxel_m: float = Field(default=0.5, gt=0)
    min_overlap: float = Field(default=0.03, gt=0, le=1)
    min_log_odds: float = 1.0
    min_agreeing_points: int = Field(default=300, ge=1)


class JudgingSettings(Settings):
    """A use of matches that has thresholds of its own."""

    def judging(self, matching: MatchingSettings) -> MatchingSettings:
        """Return settings of a match with the thresholds of this use."""
        return matching.model_copy(update=self.model_dump(include=THRESHOLDS))


class LoopSettings(JudgingSettings):
    """Where loop candidates come from and how many are verified."""

    enabled: bool = True
    min_travel_m: float = Field(default=40.0, gt=0)
    max_candidates: int = Field(default=1, ge=1)
    min_votes: int = Field(default=6, ge=1)
    min_field_agreement: float = Field(default=0.5, ge=-2, le=2)
    nearby_m: float = Field(default=12.0, gt=0)
    max_distance_m: float = Field(default=60.0, gt=0)
    min_log_odds: float = 4.0
    min_inliers: int = Field(default=4, ge=2)
    min_overlap: float = Field(default=0.1, gt=0, le=1)


class GraphSettings(Settings):
    """Noise of the odometry and the outlier tests of the pose graph.

    The sigmas are those of one scan-to-scan step; a chain of steps adds them up. The fractions
    add to a step's sigma in proportion to how far it moved or turned. They speak for a plugin's
    user, for the live graph and where odometry does not refine on surfaces; the graph that a run
    leaves has the covariance of each scan's own alignment (``odometry/noise.py``) instead.
    ``drift_inflation`` widens them over long stretches for the outlier tests. Probabilities are
    chi-square levels with six degrees of freedom: the share of true loops that a test keeps when
    the covariances are honest.
    """

    odometry_rotation_sigma_deg: float = Field(default=0.02, gt=0)
    odometry_translation_sigma_m: float = Field(default=0.006, gt=0)
    odometry_rotation_fraction: float = Field(default=0.005, ge=0)
    odometry_translation_fraction: float = Field(default=0.002, ge=0)
    drift_inflation: float = Field(default=2.0, ge=1)
    odometry_check_probability: float = Field(default=0.999, gt=0, lt=1)
    odometry_check_inflation: float = Field(default=2.0, ge=1)
    pairwise_probability: float = Field(default=0.9999, gt=0, lt=1)
    min_agreeing_loops: int = Field(default=3, ge=1)
    lone_loop_max_sigma_m: float = Field(default=20.0, gt=0)
    gnc_outlier_probability: float = Field(default=0.01, gt=0, lt=1)


class WorldSettings(Settings):
    """GPS and attitude of other sensors: what their files do not say.

    ``antenna_*`` is the antenna in the lidar frame (the lever arm). The sigmas are taken where a
    file gives none. ``kept_probability`` is the share of honest fixes that count: one farther off
    (chi-square) is left out.
    """

    antenna_x_m: float = 0.0
    antenna_y_m: float = 0.0
    antenna_z_m: float = 0.0
    position_sigma_m: float = Field(default=3.0, gt=0)
    attitude_sigma_deg: float = Field(default=1.0, gt=0)
    kept_probability: float = Field(default=0.999, gt=0, lt=1)


class MapSettings(Settings):
    """The line map that a run leaves."""

    merge_distance_m: float = Field(default=0.4, gt=0)
    merge_angle_deg: float = Field(default=8.0, gt=0)
    merge_gap_m: float = Field(default=1.0, ge=0)
    min_support: int = Field(default=2, ge=1)
    min_seen_share: float = Field(default=0.15, ge=0, le=1)
    clouds: bool = True
    cloud_voxel_m: float = Field(default=0.8, gt=0)
    cloud_min_keyframes: int = Field(default=2, ge=1)


class RelocalizationSettings(JudgingSettings):
    """What a place of a saved map must show; it differs from a scan: it has seen more sides."""

    min_log_odds: float = 0.0
    min_inliers: int = Field(default=5, ge=2)
    min_overlap: float = Field(default=0.1, gt=0, le=1)


class SlamConfig(Settings):
    """All settings of a run."""

    seed: int = Field(default=0, ge=0)
    input: InputSettings = InputSettings()
    odometry: OdometrySettings = OdometrySettings()
    keyframes: KeyframeSettings = KeyframeSettings()
    lines: LineSettings = LineSettings()
    matching: MatchingSettings = MatchingSettings()
    loops: LoopSettings = LoopSettings()
    graph: GraphSettings = GraphSettings()
    world: WorldSettings = WorldSettings()
    map: MapSettings = MapSettings()
    relocalization: RelocalizationSettings = RelocalizationSettings()


def load_config(path: Path | str | None = None, overrides: Sequence[str] = ()) -> SlamConfig:
    """Return the defaults, changed by a YAML file and then by ``section.key=value`` overrides.

    Raises
    ------
    ConfigError
        naming the file or the override and the full key.
    """
    tree = {} if path is None else _read_yaml(Path(path))
    source = "--set" if path is None else str(path)
    for override in overrides:
        _apply(tree, override)
    try:
        return SlamConfig.model_validate(tree)
    except ValidationError as error:
        problem = error.errors()[0]
        key = ".".join(str(part) for part in problem["loc"]) or "(top level)"
        if any(override.startswith((f"{key}=", f"{key}.")) for override in overrides):
            source = "--set"
        raise ConfigError(f"{source}: {_explain(key, problem)}") from None


def dump_config(config: SlamConfig) -> str:
    """Return the resolved settings as YAML that :func:`load_config` reads back."""
    return yaml.safe_dump(config.model_dump(), sort_keys=False)


def _explain(key: str, problem: Mapping[str, Any]) -> str:
    if problem["type"] == "extra_forbidden":
        return f"{key} is not a setting{_suggestion(key)}"
    if problem["type"] == "model_type":
        return f"{key} is a section; expected keys below it, found {_show(problem['input'])}"
    if problem["type"] == "value_error":
        return f"{key}: {problem['ctx']['error']}"
    return f"{key}: {problem['msg']}, found {_show(problem['input'])}"


def _show(value: object) -> str:
    return f"a {type(value).__name__}" if isinstance(value, dict | list) else repr(value)[:80]


def _suggestion(key: str) -> str:
    keys = _all_keys(SlamConfig().model_dump())
    leaf = key.rpartition(".")[2]
    near = [known for known in keys if known.rpartition(".")[2] == leaf]
    near = near or get_close_matches(key, keys, n=1, cutoff=0.75)
    return f"; did you mean {' or '.join(near)}?" if near else ""


def _all_keys(tree: dict[str, Any], prefix: str = "") -> list[str]:
    keys = []
    for name, value in tree.items():
        keys.append(prefix + name)
        if isinstance(value, dict):
            keys += _all_keys(value, f"{prefix}{name}.")
    return keys


def _read_yaml(path: Path) -> dict[Any, Any]:
    try:
        if path.stat().st_size > MAX_CONFIG_BYTES:
            raise ConfigError(f"{path}: larger than {MAX_CONFIG_BYTES} bytes, not a settings file")
        tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read as a settings file ({error.strerror})") from None
    except (yaml.YAMLError, ValueError, RecursionError):
        raise ConfigError(f"{path}: not valid YAML; expected 'section:' and 'key: value'") from None
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise ConfigError(f"{path}: expected sections with keys, found a {type(tree).__name__}")
    sections = SlamConfig().model_dump()
    empty = [
        key for key, value in tree.items() if value is None and isinstance(sections.get(key), dict)
    ]
    return tree | {key: {} for key in empty}


def _apply(tree: dict[str, Any], override: str) -> None:
    key, separator, text = override.partition("=")
    if not separator or not key:
        raise ConfigError(f"--set {override}: expected section.key=value")
    try:
        value = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError):
        raise ConfigError(f"--set {override}: the value is not valid YAML") from None
    *sections, leaf = key.split(".")
    for section in sections:
        node = tree.setdefault(section, {})
        if not isinstance(node, dict):
            raise ConfigError(f"--set {override}: {section} is not a section")
        tree = node
    tree[leaf] = value
