"""What flows between the stages: ScanLog -> SlamMap -> PointCloud -> SurfaceMap (of data sets, then of the map).

All of it is frozen and checked for shape when made. Units: metres, radians; times are integer nanoseconds, as in ROS
stamps (a float64 of seconds since 1970 holds only 0.2 microseconds). Frames: `map`, `base_link` (x forward, y left,
z up), and the two laser frames, in which a beam at angle phi points to (cos phi, sin phi, 0).
"""

from bsmap_cli.model.arrays import Array, IntArray
from bsmap_cli.model.records import (
    LaserScans,
    LineMap,
    LoopClosures,
    PointCloud,
    ScanLog,
    ScatteredCloud,
    SlamMap,
    StepStatistics,
    Trajectory,
    no_closures,
    segment_ends,
)
from bsmap_cli.model.surfaces import (
    BSplineSurface,
    Crease,
    DataSet,
    Decision,
    HeightCovariance,
    Placement,
    PosePart,
    Residuals,
    SurfaceCovariance,
    SurfaceMap,
    TrimLoop,
)

__all__ = [
    "Array",
    "BSplineSurface",
    "Crease",
    "DataSet",
    "Decision",
    "HeightCovariance",
    "IntArray",
    "LaserScans",
    "LineMap",
    "LoopClosures",
    "Placement",
    "PointCloud",
    "PosePart",
    "Residuals",
    "ScanLog",
    "ScatteredCloud",
    "SlamMap",
    "StepStatistics",
    "SurfaceCovariance",
    "SurfaceMap",
    "Trajectory",
    "TrimLoop",
    "no_closures",
    "segment_ends",
]
