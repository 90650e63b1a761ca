"""What a run has found so far, so that an interrupted one need not find it again.

To resume is to map the drive again from its first scan, with everything that the journal knows
looked up instead of worked out: odometry's poses, the views of keyframes and what came of their
loop search. All else follows from these, so the outcome is that of a run without interruption.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Transform
from sl3d_slam.records import RecordFile
from sl3d_slam.types import LoopConstraint, RegisteredScan, Rejection

FOLDER, FILE = ".journal", "records"
IDENTITY, MODEL = "run", "line model"
_KINDS = {kind.__name__: kind for kind in (LoopConstraint, Rejection)}

Outcome = LoopConstraint | Rejection


class Journal:
    """The notes of one run; ``records`` also hold the views of its keyframes.

    As a context it goes when the run is finished, or when it was stopped by an InputError and had
    not been resumed; it stays after a full disk, Ctrl-C, a kill.
    """

    def __init__(self, records: RecordFile | None = None, folder: Path | None = None) -> None:
        """Keep notes in a file, or in a temporary one that ends with the run."""
        self.records = RecordFile.temporary() if records is None else records
        self._folder = folder
        self._resumed = _scan_name(0) in self.records

    def __enter__(self) -> "Journal":
        """Begin."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Remove what nobody can resume; close what somebody may."""
        if error is None or (isinstance(error, InputError) and not self._resumed):
            self.remove()
        else:
            self.close()

    @property
    def model(self) -> str:
        """The line model of the views, once one was noted."""
        return self.records[MODEL].decode()

    def note_model(self, model: str) -> None:
        """Note the line model of the views; raise InputError where they were another's."""
        if MODEL not in self.records:
            self.records[MODEL] = model.encode()
        elif self.model != model:
            raise InputError(
                f"the interrupted run found lines with {self.model}; expected that model, "
                f"not {model}"
            )

    def pose(self, scan_index: int) -> Transform | None:
        """Return the noted ``T_odom_lidar`` of a scan, to the bit, or None."""
        name = _scan_name(scan_index)
        if name not in self.records:
            return None
        return np.frombuffer(self.records[name])[1:17].reshape(4, 4).copy()

    def note_scan(self, scan_index: int, scan: RegisteredScan) -> RegisteredScan:
        """Note odometry's pose of a scan; return the scan with what is noted of it.

        Raises
        ------
        InputError
            where the scan was noted before with another number of points.
        """
        name, count = _scan_name(scan_index), len(scan.points_lidar)
        if name not in self.records:
            own = np.empty(0) if scan.covariance is None else scan.covariance.ravel()
            self.records[name] = np.r_[float(count), scan.T_odom_lidar.ravel(), own].tobytes()
            return scan
        noted = np.frombuffer(self.records[name])
        if noted[0] != count:
            raise InputError(
                f"scan {scan_index} has {count} points, but had another number before the run was "
                "interrupted; expected the same scans"
            )
        covariance = noted[17:].reshape(6, 6).copy() if len(noted) > 17 else None
        return replace(scan, covariance=covariance)

    def outcomes(self, keyframe_id: int) -> list[Outcome] | None:
        """Return what came of the loop search from a keyframe, or None where nothing is noted."""
        name = f"loops {keyframe_id}"
        if name not in self.records:
            return None
        return [_from_tree(tree) for tree in json.loads(self.records[name])]

    def note_outcomes(self, keyframe_id: int, outcomes: Sequence[Outcome]) -> list[Outcome]:
        """Note what came of the loop search from a keyframe; return it as it will be read.

        Numbers are the same, but arrays may lie differently in memory, and the last bit of a
        product depends on that.
        """
        trees = [_tree(outcome) for outcome in outcomes]
        self.records[f"loops {keyframe_id}"] = json.dumps(trees).encode()
        return [_from_tree(tree) for tree in trees]

    def close(self) -> None:
        """Close the file; a journal in a run folder stays."""
        self.records.close()

    def remove(self) -> None:
        """Close the journal and take it away: the run is finished."""
        self.close()
        if self._folder is not None:
            (self._folder / FILE).unlink(missing_ok=True)
            self._folder.rmdir()


def open_journal(run_folder: Path, identity: Mapping[str, str], resume: bool) -> Journal:
    """Open the journal of a run folder, or begin one.

    Parameters
    ----------
    identity : what must be the same for a run to be continued, by its name in a sentence.
    resume : whether an interrupted run there may be continued.

    Raises
    ------
    InputError
        where there is an interrupted run that is not to be resumed, or that was another.
    """
    folder = run_folder / FOLDER
    records = RecordFile.open(folder / FILE)
    if _scan_name(0) not in records:
        records[IDENTITY] = json.dumps(dict(identity)).encode()
        return Journal(records, folder)
    if not resume:
        records.close()
        raise InputError(
            f"{run_folder}: holds an interrupted run; --resume continues it, and without {FOLDER} "
            "in that folder a new one begins"
        )
    known = json.loads(records[IDENTITY])
    for name, value in identity.items():
        if known.get(name) != value:
            records.close()
            raise InputError(f"{run_folder}: the interrupted run there had another {name}")
    return Journal(records, folder)


def _scan_name(scan_index: int) -> str:
    return f"scan {scan_index}"


def _tree(outcome: Outcome) -> dict[str, Any]:
    fields = {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in asdict(outcome).items()
    }
    return {"kind": type(outcome).__name__, **fields}


def _from_tree(tree: dict[str, Any]) -> Outcome:
    """Undo :func:`_tree`; JSON keeps every bit of a float."""
    kind: Any = _KINDS[tree.pop("kind")]
    return kind(**{k: np.array(v) if isinstance(v, list) else v for k, v in tree.items()})
