"""Materials that several rooms share."""

from nbtrack.synthetic.materials import Plain, Wood

OAK = Wood((0.80, 0.62, 0.42), (0.62, 0.44, 0.27))
OAK_X = Wood((0.80, 0.62, 0.42), (0.62, 0.44, 0.27), direction=(1.0, 0.0, 0.0))
WALNUT = Wood((0.50, 0.34, 0.23), (0.34, 0.22, 0.14), period=0.4)
WALNUT_X = Wood((0.50, 0.34, 0.23), (0.34, 0.22, 0.14), period=0.4, direction=(1.0, 0.0, 0.0))
WHITE = Plain((0.90, 0.89, 0.86), 0.05, seed=1)
CEILING = Plain((0.95, 0.94, 0.92), 0.05, 0.7, seed=2)
METAL = Plain((0.34, 0.35, 0.37), 0.1, 0.3, seed=3)
SCREEN = Plain((0.10, 0.12, 0.16), 0.5, 0.25, seed=4)
LAMPSHADE = Plain((1.0, 0.93, 0.76), 0.04, seed=5)
LEAVES = Plain((0.30, 0.52, 0.26), 0.4, 0.2, seed=6)
TERRACOTTA = Plain((0.76, 0.44, 0.30), 0.12, 0.3, seed=7)
DAYLIGHT = Plain((0.80, 0.92, 1.0), 0.1, 0.8, seed=8)
