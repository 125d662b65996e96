"""One picture, deblurred: linear light in, grey levels out, by the method that the settings name."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from virest.restoration.blurred import BlurredPicture
from virest.restoration.settings import RestorationSettings
from virest.restoration.tile_methods import by_tile_filter, by_tile_hyper_laplacian
from virest.restoration.whole_picture import by_global_hyper_laplacian, by_richardson_lucy


def deblur(blurred: BlurredPicture, settings: RestorationSettings) -> NDArray[np.uint8]:
    """The sharp picture (height, width, 3), through the curve again, at the kernels' anchor."""
    methods: dict[str, Callable[[BlurredPicture, RestorationSettings], NDArray[np.uint8]]] = {
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
