"""Settings of the joint training, written beside its weights."""

from pydantic import Field

from sl3d_slam.config import Settings


class LossSettings(Settings):
    """The paper's five terms, and one that ranks.

    ``segmentation`` is the paper's omega; ``discriminative`` weighs its other four terms, 1 in the
    paper. ``same_margin`` and ``differ_margin`` are its delta_s and 2 delta_d, for L1 distances of
    unit vectors. Two random unit vectors of 64 numbers are about 9 apart in L1, so the larger
    margin of 2 is met at some 18 degrees: those terms tell lines apart but soon stop spreading
    them. ``contrast`` weighs a cross-entropy over the candidates of the other scan, which is the
    ranking that matching uses; 0 leaves the paper's loss alone.
    """

    segmentation: float = Field(default=2.0, ge=0)
    discriminative: float = Field(default=0.0, ge=0)
    same_margin: float = Field(default=0.2, ge=0)
    differ_margin: float = Field(default=2.0, gt=0)
    contrast: float = Field(default=1.0, ge=0)
    temperature: float = Field(default=0.07, gt=0)
    background_share: float = Field(default=0.6, gt=0, lt=1)


class AugmentSettings(Settings):
    """How a cloud is changed before it is shown: yaw is always drawn from the full circle."""

    max_tilt_deg: float = Field(default=4.0, ge=0, le=30)
    max_thinning: float = Field(default=0.5, ge=0, lt=1)
    beam_share: float = Field(default=0.35, ge=0, le=1)
    noise_m: float = Field(default=0.015, ge=0)
    height_noise_m: float = Field(default=0.1, ge=0)


class JointSettings(Settings):
    """Everything that the weights depend on beside the data."""

    steps: int = Field(default=6500, ge=1)
    pairs_per_step: int = Field(default=1, ge=1)
    points: int = Field(default=12_000, ge=50)
    learning_rate: float = Field(default=2e-3, gt=0)
    warmup_steps: int = Field(default=100, ge=0)
    seed: int = Field(default=0, ge=0)
    max_pair_distance_m: float = Field(default=30.0, gt=0)
    match_distance_m: float = Field(default=0.2, gt=0)
    min_line_points: int = Field(default=4, ge=1)
    real_share: float = Field(default=0.4, ge=0, le=1)
    loss: LossSettings = LossSettings()
    augment: AugmentSettings = AugmentSettings()
