"""Undoing the degradation: deconvolution in linear light, then one warp."""
