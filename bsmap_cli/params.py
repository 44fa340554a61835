"""Parameters of the stages: one frozen dataclass a stage, the only home of defaults.

Every field is an option of the stage's command: `parameter` gives the help, the unit and the limits; angles are
radians here and degrees on the command line (unit "rad" is converted in cli/options.py).
"""

import math
from dataclasses import dataclass, field, fields
from typing import Any

from bsmap_cli.errors import ParameterError


def parameter(
    default: Any,
    help: str,
    unit: str = "",
    minimum: float | None = None,
    maximum: float | None = None,
    choices: tuple[str, ...] = (),
    name: str = "",
) -> Any:
    """Field of a parameter class; `name` is the option's name where it differs from the field's."""
    metadata = {"help": help, "unit": unit, "min": minimum, "max": maximum, "choices": choices, "name": name}
    return field(default=default, metadata=metadata)


class Checked:
    """Base of the parameter classes: values outside their limits raise ParameterError when made."""

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]
            value, meta = getattr(self, f.name), f.metadata
            low, high, choices = meta["min"], meta["max"], meta["choices"]
            if choices and value not in choices:
                raise ParameterError(f"{f.name}: {value!r} is not one of {', '.join(choices)}")
            if isinstance(value, float) and math.isnan(value):
                raise ParameterError(f"{f.name}: nan is not a value")
            if value is not None and ((low is not None and value < low) or (high is not None and value > high)):
                raise ParameterError(f"{f.name}: {value} is outside [{low}, {high}]")


@dataclass(frozen=True)
class LogParams(Checked):
    """Which topics of a log play which part; None: found from the mounts."""

    horizontal_topic: str | None = parameter(None, "Topic of the horizontal laser (default: found from the mounts).")
    vertical_topic: str | None = parameter(None, "Topic of the vertical laser (default: found from the mounts).")
    odometry_topic: str | None = parameter(None, "Topic of the odometry (default: the only one).")
    use_odometry: bool = parameter(True, "Use odometry as prior; without it, constant velocity.", name="odometry")


@dataclass(frozen=True)
class SlamParams(Checked):
    """Trajectory and line map, method.md sections 1-4 and 10."""

    method: str = parameter("graph", "Smoothed graph, or the paper's filter alone.", choices=("graph", "paper"))
    range_sigma: float | None = parameter(
        None, "Standard deviation of a range (default: from the log).", "m", 1e-4, 1.0
    )
    angle_sigma: float = parameter(0.0005, "Standard deviation of a beam's direction.", "rad", 0.0, 0.1)
    breakpoint_angle: float = parameter(
        math.radians(10.0), "Smallest angle of incidence at which neighbouring points still join.", "rad", 0.001, 1.5
    )
    split_distance: float = parameter(0.05, "Points farther off their segment's chord split it.", "m", 0.001, 1.0)
    min_points: int = parameter(6, "Fewest points of a segment.", "", 3)
    min_length: float = parameter(0.3, "Shortest segment.", "m", 0.01)
    line_angle_floor: float = parameter(0.0005, "Floor of a line's angle error: no wall is flat.", "rad", 0.0, 0.1)
    line_offset_floor: float = parameter(0.001, "Floor of a line's offset error: no wall is flat.", "m", 0.0, 0.5)
    odometry_translation: float = parameter(0.1, "Odometry's error in place for each metre driven.", "m", 0.0, 1.0)
    odometry_rotation: float = parameter(0.1, "Odometry's error in heading for each radian turned.", "", 0.0, 1.0)
    odometry_coupling: float = parameter(
        0.03, "Error in heading for each metre, in place for each radian.", "", 0.0, 1.0
    )
    acceleration: float = parameter(1.0, "Without odometry: usual change of speed a second (m/s, rad/s).", "", 0.01)
    gate: float = parameter(0.99, "Share of true pairs that the compatibility tests let pass.", "", 0.5, 0.999999)
    group_size: int = parameter(4, "Segments in a group of the partial compatibility algorithm.", "", 1, 8)
    overlap_margin: float = parameter(0.3, "Segments of one wall may lie this far apart along it.", "m", 0.0)
    tentative_hits: int = parameter(3, "Scans that must see a line before it stays for good.", "", 1)
    tentative_scans: int = parameter(10, "Key scans after which a line that did not come again is dropped.", "", 1)
    update_distance: float = parameter(0.02, "Filter alone: movement below which a scan adds nothing.", "m", 0.0)
    update_angle: float = parameter(
        math.radians(0.5), "Filter alone: rotation below which a scan adds nothing.", "rad", 0.0
    )
    match_distance: float = parameter(0.05, "Movement below which a scan is not matched.", "m", 0.0)
    match_angle: float = parameter(0.05, "Rotation below which a scan is not matched.", "rad", 0.0)
    key_distance: float = parameter(0.3, "Movement after which a scan becomes a key scan.", "m", 0.0)
    key_angle: float = parameter(0.3, "Rotation after which a scan becomes a key scan.", "rad", 0.0)


@dataclass(frozen=True)
class CloudParams(Checked):
    """Point cloud of the vertical laser, method.md section 5."""

    range_min: float = parameter(0.0, "Drop beams shorter than this.", "m", 0.0)
    range_max: float = parameter(float("inf"), "Drop beams longer than this.", "m", 0.0)
    range_sigma: float | None = parameter(
        None, "Standard deviation of a range (default: from the log).", "m", 1e-6, 1.0
    )
    angle_sigma: float = parameter(0.0005, "Standard deviation of a beam's direction.", "rad", 0.0, 0.1)


@dataclass(frozen=True)
class FitParams(Checked):
    """Movement data sets and B-spline surfaces, method.md sections 6-8."""

    method: str = parameter(
        "faces", "One surface for each smooth face, or the paper's one for each data set.", choices=("faces", "paper")
    )
    degree_u: int = parameter(3, "Degree along the scan lines.", "", 1, 7)
    degree_v: int = parameter(3, "Degree across the scan lines.", "", 1, 7)
    bound_u: float = parameter(0.01, "Largest error allowed along the scan lines.", "m", 1e-4)
    bound_v: float = parameter(0.05, "Largest error allowed across the scan lines.", "m", 1e-4)
    knots_per_pass: int = parameter(100, "Knots inserted before each new fit.", "", 1, 1000)
    noise_margin: float = parameter(
        4.0, "Sigmas of the sensor's noise granted beyond the bounds (0: the paper's rule).", "", 0.0, 100.0
    )
    set_length: float = parameter(5.0, "Longest translation fitted with one surface.", "m", 0.1)


@dataclass(frozen=True)
class MergeParams(Checked):
    """Faces joined by distance, gate, flatness and gap; whole surfaces by overlap, division and fusion (section 9)."""

    distance: float = parameter(0.1, "Surfaces farther apart than this do not overlap.", "m", 1e-3)
    gate: float = parameter(0.99, "Share of true pairs that the Mahalanobis gate lets pass.", "", 0.5, 0.999999)
    bound_u: float = parameter(0.01, "Largest error allowed along u when a merged patch is fitted.", "m", 1e-4)
    bound_v: float = parameter(0.05, "Largest error allowed along v when a merged patch is fitted.", "m", 1e-4)
    flatness: float = parameter(0.002, "Standard deviation by which walls leave their faces.", "m", 1e-5, 0.1)
    align: bool = parameter(False, "Bring maps of different origin into one frame first.")
    gap: float = parameter(
        0.1, "Faces of two data sets that lie no farther apart touch; the gap is closed.", "m", 0.0, 1.0
    )


@dataclass(frozen=True)
class ExportParams(Checked):
    """Meshes and surfaces."""

    tolerance: float = parameter(0.005, "Largest distance of a mesh to its surface.", "m", 1e-5)
    format: str | None = parameter(None, "Format, where the file's ending does not tell it.")


@dataclass(frozen=True)
class SimulateParams(Checked):
    """Robot, lasers and noise of a simulated log."""

    seed: int = parameter(0, "Seed of all randomness.", "", 0)
    range_sigma: float = parameter(0.01, "Standard deviation of the noise along the beam.", "m", 0.0, 1.0)
    rate: float = parameter(10.0, "Scans a second of each laser in continuous motion.", "Hz", 0.1, 100.0)
    odometry_error: float = parameter(1.0, "Scale of the drift of the odometry (0: exact).", "", 0.0, 100.0)
