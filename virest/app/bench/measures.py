"""How close a picture is to its truth: :mod:`virest.evaluation.fidelity`, by the names that tables and stories use."""

from virest.evaluation.fidelity import MARGIN_PX, point_distances_px, psnr_db, shift_px

__all__ = ["MARGIN_PX", "point_distances_px", "psnr_db", "shift_px"]
