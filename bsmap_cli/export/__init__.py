"""Stage export: SurfaceMap -> bytes of a file that other programs read, one module a kind of product."""

from bsmap_cli.export.product import ENDINGS, choose_format, export_map

__all__ = ["ENDINGS", "choose_format", "export_map"]
