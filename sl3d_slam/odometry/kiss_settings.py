"""KISS-ICP's settings, every one given here: the library lets the environment change them."""

from kiss_icp.config import KISSConfig
from kiss_icp.config.config import (
    AdaptiveThresholdConfig,
    DataConfig,
    MappingConfig,
    RegistrationConfig,
)

from sl3d_slam.config import InputSettings, OdometrySettings

FINE_STEP_M = 3e-3


def with_step(config: KISSConfig, step_m: float) -> KISSConfig:
    """Return the settings with another length of step at which alignment stops."""
    registration = RegistrationConfig(convergence_criterion=step_m)
    return config.model_copy(update={"registration": registration})


def kiss_config(settings: OdometrySettings, scan_input: InputSettings) -> KISSConfig:
    """Fill in every value; ``model_construct`` keeps the environment out."""
    return KISSConfig.model_construct(
        data=DataConfig(
            max_range=scan_input.max_range_m,
            min_range=scan_input.min_range_m,
            deskew=scan_input.deskew,
        ),
        registration=(
            RegistrationConfig(convergence_criterion=FINE_STEP_M)
            if settings.refine_on_surfaces
            else RegistrationConfig()
        ),
        mapping=MappingConfig(
            voxel_size=settings.voxel_size_m, max_points_per_voxel=settings.max_points_per_voxel
        ),
        adaptive_threshold=AdaptiveThresholdConfig(),
    )
