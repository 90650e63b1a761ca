"""``sl3d bench ablations``: the same short training with one thing of the network changed.

The paper's ablations: stride of skip encoding, length of descriptors, neighbours found in space or
again per block among features. Short runs of everything: they tell which way a change goes, not how
far a network gets.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

from sl3d_slam.bench.tables import Column, Row, Table, write_tables
from sl3d_slam.errors import InputError
from sl3d_slam.files import prepare_run_folder
from sl3d_slam.learning.joint import CHECKPOINT
from sl3d_slam.learning.joint_run import VALIDATION, JointPlan, read_looks, train_joint
from sl3d_slam.learning.joint_settings import JointSettings
from sl3d_slam.learning.joint_validation import look_at
from sl3d_slam.learning.prepare import find_sources, prepare_drive
from sl3d_slam.learning.prepared import PreparedDrive
from sl3d_slam.lines.network.model import SuperLine3D
from sl3d_slam.lines.network.settings import NetworkSettings

BASE = NetworkSettings(stride=1)
VARIANTS: Mapping[str, Mapping[str, object]] = {
    "stride 1, 64 numbers, neighbours in space": {},
    "stride 2": {"stride": 2},
    "stride 4": {"stride": 4},
    "stride 6": {"stride": 6},
    "16 numbers a descriptor": {"descriptor_dim": 16},
    "32 numbers a descriptor": {"descriptor_dim": 32},
    "128 numbers a descriptor": {"descriptor_dim": 128},
    "neighbours among features": {"neighbours": "features"},
}
TIMED_SCANS = 5
COLUMNS = (
    Column("variant", "network"),
    Column("best_f1", "best F1 of points", "{:.3f}"),
    Column("five_10m", "in top five, 10 m", "{:.0%}"),
    Column("five_20m", "20 m", "{:.0%}"),
    Column("five_30m", "30 m", "{:.0%}"),
    Column("chance_five", "by chance", "{:.0%}"),
    Column("cost_ms", "processor ms a scan", "{:.0f}"),
)
Progress = Callable[[str, int], None]


@dataclass(frozen=True, slots=True)
class Ablations:
    """What is trained on and measured on, and for how long; ``cache`` keeps prepared drives."""

    data: tuple[Path, ...]
    held_out: Path
    steps: int = 300
    points: int = 6000
    seed: int = 0
    cache: Path | None = None
    variants: Mapping[str, Mapping[str, object]] = field(default_factory=lambda: VARIANTS)


def run(
    what: Ablations,
    out: Path,
    command: str = "sl3d bench ablations",
    progress: Progress = lambda note, steps: None,
) -> Table:
    """Train and measure every variant; leave ``ablations.csv``, ``.md`` and a picture of the table.

    What was trained before in ``out`` with the same settings is not trained again.

    Raises
    ------
    InputError
        where a drive cannot be used, or the one held out is also among those learned from.
    OutputError
        where ``out`` cannot be written.
    """
    prepare_run_folder(out)
    if what.held_out.resolve() in [path.resolve() for path in what.data]:
        raise InputError(f"{what.held_out}: a drive held out is not one to learn from")
    note = (
        f"each trained for {what.steps} steps of two clouds of at most {what.points} points, "
        "which is short: differences of 3 % are within what another seed changes"
    )
    rows = list(_rows(what, out, progress))
    table = Table(f"Ablations, measured on {what.held_out.name}", COLUMNS, rows, [note])
    write_tables(out, "ablations", [table], command)
    return table


def _rows(what: Ablations, out: Path, progress: Progress) -> Iterator[Row]:
    cache = what.cache or out / "prepared"
    (source,) = find_sources([what.held_out], ())
    held_out = prepare_drive(source, cache, BASE, lambda note: progress(note, 0))
    settings = JointSettings(steps=what.steps, points=what.points, seed=what.seed)
    for number, (name, changes) in enumerate(what.variants.items()):
        plan = _plan(what, out / f"{number}", cache)
        network = NetworkSettings.model_validate(BASE.model_dump() | dict(changes))
        model = train_joint(plan, settings, network, progress=_told(progress, name))
        yield {
            "variant": name,
            **asdict(read_looks(plan.out / VALIDATION, what.steps)[-1]),
            "weights": sum(weight.numel() for weight in model.parameters()),
            "cost_ms": cost_ms(model, held_out),
        }


def _plan(what: Ablations, folder: Path, cache: Path) -> JointPlan:
    return JointPlan(
        what.data,
        folder,
        held_out=(what.held_out,),
        resume=(folder / CHECKPOINT).is_file(),
        cache=cache,
        checkpoint_every=what.steps,
    )


def _told(progress: Progress, name: str) -> Progress:
    """Return a progress that names the variant it is about."""
    return lambda note, steps: progress(f"{name}: {note}", steps)


def cost_ms(model: SuperLine3D, drive: PreparedDrive) -> float:
    """Return the processor time of neighbours, encoder and both heads, the mean of a few scans."""
    scans = drive.scans[:: max(1, len(drive.scans) // TIMED_SCANS)][:TIMED_SCANS]
    look_at(model, scans[0])  # compiles
    start = time.process_time()
    for scan in scans:
        look_at(model, scan)
    return 1000.0 * (time.process_time() - start) / len(scans)
