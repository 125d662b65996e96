"""Deblur one picture by the method in the settings: linear light in, grey levels out."""

from __future__ import annotations

from collections.abc import Callable

from virest.restoration.blurred import BlurredPicture
from virest.restoration.row_chunks import RowRenderer
from virest.restoration.settings import RestorationSettings
from virest.restoration.tile_methods import by_tile_filter, by_tile_hyper_laplacian
from virest.restoration.whole_picture import by_global_hyper_laplacian, by_richardson_lucy


def deblur(blurred: BlurredPicture, settings: RestorationSettings) -> RowRenderer:
    """The sharp picture at the kernels' anchor, encoded by the tone curve.  Raises ValueError for an unknown method."""
    methods: dict[str, Callable[[BlurredPicture, RestorationSettings], RowRenderer]] = {
        "inverse": by_tile_filter,
        "wiener": by_tile_filter,
        "gradient-wiener": by_tile_filter,
        "hyper-laplacian": by_tile_hyper_laplacian,
        "richardson-lucy": by_richardson_lucy,
        "hyper-laplacian-global": by_global_hyper_laplacian,
    }
    if settings.deblur not in methods:
        raise ValueError(f"no deblurring method '{settings.deblur}'")
    return methods[settings.deblur](blurred, settings)
