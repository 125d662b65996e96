"""Unknown effects as fields: what tracked points do along recorded covariates, after every named cause."""
