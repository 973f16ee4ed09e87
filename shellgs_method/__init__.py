"""ShellGS: Gaussian splatting of building facades, supervised by an aligned exterior shell."""
