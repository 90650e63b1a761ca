"""What ``sl3d train joint`` does: prepare drives, train, and look at drives left out."""

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path

import torch

from sl3d_slam.errors import InputError
from sl3d_slam.files import prepare_run_folder, write_whole
from sl3d_slam.learning.joint import JointTraining, Progress
from sl3d_slam.learning.joint_settings import JointSettings
from sl3d_slam.learning.joint_validation import detect, rank
from sl3d_slam.learning.parallel import Team, joined_team
from sl3d_slam.learning.prepare import find_sources, prepare_drive
from sl3d_slam.learning.prepared import PreparedDrive
from sl3d_slam.learning.single_scans import prepare_singles
from sl3d_slam.learning.surroundings import without_surroundings
from sl3d_slam.lines.network.model import SuperLine3D
from sl3d_slam.lines.network.settings import NetworkSettings
from sl3d_slam.lines.network.weights_file import load_weights

VALIDATION, PREPARED = "validation.csv", "prepared"


@dataclass(frozen=True, slots=True)
class JointPlan:
    """What to train on and with.

    ``singles`` are folders of scans of unrelated places, labelled by ``start`` or, without it, by
    geometry.
    ``start`` are weights to start from, ``held_out`` drives to look at and never to learn from;
    ``stop`` is the step to leave the run at, as if it were killed there; ``threads`` are those of
    one process.
    """

    data: tuple[Path, ...]
    out: Path
    labels: tuple[Path, ...] = ()
    singles: tuple[Path, ...] = ()
    held_out: tuple[Path, ...] = ()
    start: Path | None = None
    resume: bool = False
    cache: Path | None = None
    checkpoint_every: int = 200
    stop: int | None = None
    threads: int = 1


@dataclass(frozen=True, slots=True)
class Look:
    """One row of ``validation.csv``: shares from 0 to 1 on one drive after some steps."""

    step: int
    drive: str
    precision: float
    recall: float
    best_f1: float
    best_threshold: float
    first_10m: float
    five_10m: float
    first_20m: float
    five_20m: float
    first_30m: float
    five_30m: float
    chance_five: float


def train_joint(
    plan: JointPlan,
    settings: JointSettings,
    network: NetworkSettings,
    prepared: Callable[[str], None] = lambda _: None,
    progress: Progress = lambda note, steps: None,
) -> SuperLine3D:
    """Train a network and return it; the folder of the plan gets everything else.

    The same plan and settings give the same weights on one thread, in one go or resumed.

    Raises
    ------
    InputError
        where a drive, labels, weights or a checkpoint cannot be used.
    OutputError
        where the folder cannot be written to.
    """
    torch.set_num_threads(plan.threads)
    for folder in (plan.out, cache_of(plan)):
        prepare_run_folder(folder)
    with joined_team() as team:
        model = start_model(network, settings, plan.start)
        drives, singles, held_out = _prepare_together(plan, model.settings, team, prepared)
        training = JointTraining(model, drives, settings, plan.out, team, singles)
        if plan.resume:
            training.resume()
            progress("resumed", training.step)
        looks = read_looks(plan.out / VALIDATION, training.step) if plan.resume else []

        def look(step: int) -> None:
            looks.extend(look_at_drive(model, drive, step) for drive in held_out)
            if looks:
                write_looks(plan.out / VALIDATION, looks)

        training.run(progress, plan.checkpoint_every, plan.stop, look)
    return model


def start_model(
    network: NetworkSettings, settings: JointSettings, start: Path | None
) -> SuperLine3D:
    """Return a new network drawn from the seed, or the one of a weights file, and its settings."""
    if start is not None:
        return without_surroundings(load_weights(start))
    torch.manual_seed(settings.seed)
    return SuperLine3D(network)


def _prepare_together(
    plan: JointPlan, network: NetworkSettings, team: Team, progress: Callable[[str], None]
) -> tuple[list[PreparedDrive], list[PreparedDrive], list[PreparedDrive]]:
    """Prepare in one process what the others then find in the cache; it alone looks at results.

    Returns drives, singles and drives held out.
    """
    held_out = []
    if team.leads:
        drives, singles = _prepare_learned_from(plan, network, progress)
        held_out = _prepare(plan, plan.held_out, network, progress)
    team.wait()
    if not team.leads:
        drives, singles = _prepare_learned_from(plan, network, progress)
    return drives, singles, held_out


def _prepare_learned_from(
    plan: JointPlan, network: NetworkSettings, progress: Callable[[str], None]
) -> tuple[list[PreparedDrive], list[PreparedDrive]]:
    singles = [
        prepare_singles(folder, cache_of(plan), network, plan.start, progress)
        for folder in plan.singles
    ]
    return _prepare(plan, plan.data, network, progress), singles


def cache_of(plan: JointPlan) -> Path:
    """Return where prepared drives are kept."""
    return plan.cache or plan.out / PREPARED


def _prepare(
    plan: JointPlan,
    data: Sequence[Path],
    network: NetworkSettings,
    progress: Callable[[str], None],
) -> list[PreparedDrive]:
    drives = [
        prepare_drive(source, cache_of(plan), network, progress)
        for source in find_sources(data, plan.labels)
    ]
    return [replace(drive, name=f"{index}:{drive.name}") for index, drive in enumerate(drives)]


def look_at_drive(model: SuperLine3D, drive: PreparedDrive, step: int) -> Look:
    """Measure a network on one drive."""
    found, rankings = detect(model, drive), rank(model, drive)
    near, middle, far = rankings
    return Look(
        step=step,
        drive=drive.name,
        precision=found.precision,
        recall=found.recall,
        best_f1=found.best_f1,
        best_threshold=found.best_threshold,
        first_10m=near.first,
        five_10m=near.top_five,
        first_20m=middle.first,
        five_20m=middle.top_five,
        first_30m=far.first,
        five_30m=far.top_five,
        chance_five=far.chance_five,
    )


def write_looks(path: Path, looks: Sequence[Look]) -> None:
    """Write one row a look under the names of the columns."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow([field.name for field in fields(Look)])
    for look in looks:
        table.writerow(
            [f"{value:.4f}" if isinstance(value, float) else value for value in astuple(look)]
        )
    write_whole(path, text.getvalue())


def read_looks(path: Path, last_step: int) -> list[Look]:
    """Return the rows of an earlier part of a run, none where there are none. Raises InputError."""
    if not path.is_file():
        return []
    try:
        rows = csv.DictReader(path.read_text(encoding="utf-8").splitlines())
        looks = [
            Look(
                **{
                    name: {"step": int, "drive": str}.get(name, float)(value)
                    for name, value in row.items()
                }
            )
            for row in rows
        ]
    except (OSError, ValueError, TypeError):
        raise InputError(f"{path}: expected the validation of a training run") from None
    return [look for look in looks if look.step <= last_step]
