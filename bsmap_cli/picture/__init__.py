"""Pictures of what the stages made: a run as a whole, and SLAM by itself."""

from bsmap_cli.picture.run import draw_run
from bsmap_cli.picture.slam import draw_slam

__all__ = ["draw_run", "draw_slam"]
