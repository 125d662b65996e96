"""What a blurred picture says of itself: the spectrum of its noise and that of its sharp content.

The predicted kernels K pass some frequencies and cancel others.  What a picture holds where they cancel is noise (of
the sensor, of the movie's codec, and of kernels that are not quite right); what it holds where they pass is the sharp
picture.  So |G|² = |K|² S + N, fitted over the tiles in rings of equal frequency, measures both: the regularisation
is no constant, and a predicted blur that the picture does not show comes out as noise and is left alone.

Grey levels throughout; a white noise of standard deviation σ has N = σ².

Blur adds up light, and a steep curve gives the grey levels of a blurred edge frequencies that no light had: where the
kernels cancel, they would pass for noise.  So its standard deviation, which weighs the data against the prior, is
measured in light, brought to grey levels by the curve's slope at each tile's mean.

Rings take S to be the same in all directions.  A grating, a brick wall or blinds have their power at few places of a
ring: where these pass and others are cancelled, S is believed there too, and noise and errors of the kernels are
restored for detail.  The fit's misfit tells such pictures, and their S is measured place by place.
"""
