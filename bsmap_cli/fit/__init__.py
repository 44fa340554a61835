"""PointCloud -> SurfaceMap: B-spline surfaces with covariance of each data set, method.md sections 6-8 and 10."""

from bsmap_cli.fit.faces import fit_faces
from bsmap_cli.fit.movement import divide
from bsmap_cli.fit.paper import fit_paper
from bsmap_cli.fit.surface import fit_scan_lines
from bsmap_cli.fit.unorganised import fit_unorganised
from bsmap_cli.model import PointCloud, SurfaceMap
from bsmap_cli.params import FitParams
from bsmap_cli.track import Track, silent

__all__ = ["divide", "fit_scan_lines", "fit_surfaces", "fit_unorganised"]


def fit_surfaces(cloud: PointCloud, params: FitParams, *, track: Track = silent) -> SurfaceMap:
    """Divide the cloud into data sets by movement and fit surfaces to each, by the method that `params` names.

    Raises
    ------
    BsmapError
        Where no data set gives a surface.
    """
    fit = fit_faces if params.method == "faces" else fit_paper
    return fit(cloud, params, track=track)
