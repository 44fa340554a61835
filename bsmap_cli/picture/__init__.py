"""Pictures of what the stages made: a run as a whole, and SLAM, the fit and the merge each by itself."""

from bsmap_cli.picture.fit import draw_fit
from bsmap_cli.picture.merge import draw_merge
from bsmap_cli.picture.run import draw_run
from bsmap_cli.picture.slam import draw_slam

__all__ = ["draw_fit", "draw_merge", "draw_run", "draw_slam"]
