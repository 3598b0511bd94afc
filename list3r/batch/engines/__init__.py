"""Engines that place tasks: processes of this machine (`local`) or a Ray cluster (`ray`), behind `base`."""
