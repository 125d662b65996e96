"""Restoration: deconvolution in linear light, then one warp."""
