"""Figures as the paper prints them, of its own scenes at its own size: arXiv 2607.25362, and its supplement.

Columns are those of the table; shares of pixels are in percent.
"""

from collections.abc import Mapping

Figures = Mapping[tuple[str, str], tuple[float | None, ...]]

DR, SHADER, REF, MATERIAL, PAPER = "3DGS-DR", "GaussianShader", "Ref-Gaussian", "MaterialRefGS", "PanoLess (paper)"
SILHOUETTE = "MaterialRefGS with silhouettes"
RHO, NO_SILHOUETTE, NO_NORMAL = "ρ-weighted environment", "without silhouettes", "without normal consistency"

#: Environment PSNR, SSIM, LPIPS, L1; normals: mean, median, RMSE, within 5°, 11.25°, 22.5°.
MAIN: Figures = {
    ("vase", DR): (7.96, 0.204, 0.665, 0.346, 14.7644, 5.0592, 26.7193, 49.82, 63.24, 78.73),
    ("vase", SHADER): (9.62, 0.121, 0.668, 0.264, 28.4489, 22.7388, 34.4282, 0.08, 9.08, 49.10),
    ("vase", REF): (13.63, 0.397, 0.535, 0.150, 23.1096, 17.1547, 28.8376, 1.03, 27.43, 64.48),
    ("vase", MATERIAL): (14.05, 0.474, 0.461, 0.155, 10.6664, 6.2316, 16.3371, 30.39, 83.10, 91.87),
    ("vase", PAPER): (18.51, 0.635, 0.487, 0.082, 3.9683, 2.7271, 7.2938, 88.10, 96.40, 98.87),
    ("cola", DR): (4.52, 0.270, 0.700, 0.526, 15.4632, 4.4904, 32.4032, 52.16, 74.12, 85.03),
    ("cola", SHADER): (6.47, 0.118, 0.736, 0.402, 33.5567, 23.7507, 43.7941, 0.22, 18.70, 48.23),
    ("cola", REF): (7.26, 0.249, 0.660, 0.372, 22.3515, 16.9067, 28.5207, 3.47, 27.32, 65.79),
    ("cola", MATERIAL): (6.81, 0.302, 0.587, 0.416, 10.2303, 8.0556, 13.6171, 21.55, 79.39, 93.55),
    ("cola", PAPER): (9.26, 0.442, 0.477, 0.325, 6.2487, 3.2135, 10.3550, 82.98, 87.48, 91.28),
    ("mirror", DR): (6.22, 0.274, 0.711, 0.420, 46.5904, 68.1785, 52.7519, 0.11, 2.30, 40.39),
    ("mirror", SHADER): (8.54, 0.145, 0.710, 0.297, 52.1474, 52.1432, 53.6931, 0.00, 0.00, 2.25),
    ("mirror", REF): (5.56, 0.226, 0.746, 0.457, 14.7595, 14.1869, 15.2826, 0.00, 41.67, 93.79),
    ("mirror", MATERIAL): (5.82, 0.291, 0.755, 0.449, 14.0368, 13.4597, 15.0517, 0.00, 50.75, 94.86),
    ("mirror", PAPER): (13.31, 0.337, 0.655, 0.177, 4.6389, 4.6243, 4.6456, 97.00, 97.00, 97.00),
}

#: Normals: mean, median, within 5°.
FAIRNESS: Figures = {
    ("cola", SILHOUETTE): (10.42, 8.43, 20.0),
    ("cola", PAPER): (6.25, 3.21, 83.0),
    ("vase", SILHOUETTE): (9.73, 6.09, 33.4),
    ("vase", PAPER): (3.97, 2.73, 88.1),
    ("mirror", SILHOUETTE): (14.79, 13.99, 0.0),
    ("mirror", PAPER): (4.64, 4.62, 97.0),
}

#: Environment PSNR, SSIM, LPIPS, L1; renders PSNR, SSIM, LPIPS, L1.
ABLATION: Figures = {
    ("vase", PAPER): (18.51, 0.635, 0.487, 0.082, 38.56, 0.988, 0.022, 0.002),
    ("vase", RHO): (13.94, 0.569, 0.546, 0.146, 36.16, 0.982, 0.036, 0.003),
    ("vase", NO_SILHOUETTE): (12.91, 0.466, 0.559, 0.177, 33.75, 0.977, 0.045, 0.004),
    ("vase", NO_NORMAL): (8.68, 0.098, 0.621, 0.337, 35.82, 0.978, 0.042, 0.004),
}

#: Environment PSNR, SSIM, LPIPS, L1, by how far each camera is turned.
JITTER: Figures = {
    ("vase", PAPER): (18.41, 0.637, 0.490, 0.083),
    ("vase, cameras turned by 0.5°", PAPER): (12.04, 0.341, 0.599, 0.218),
    ("vase, cameras turned by 1°", PAPER): (11.71, 0.319, 0.616, 0.224),
}
