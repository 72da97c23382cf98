"""Launch of the stage heads (cl/heads.cl)."""

from pyopencl.array import Array

from clsplat.device import Device
from clsplat.field_stages import DENSITY_SHIFT, EXPONENT_MAX

DEFINES = {"EXPONENT_MAX": EXPONENT_MAX, "DENSITY_SHIFT": DENSITY_SHIFT}


def heads_join(device: Device, features: Array, directions: Array, rays_of: Array) -> Array:
    """Join the spherical harmonics of directions with the features of samples.

    Parameters
    ----------
    features : (S, 16) real
    directions : (R, 3) real
        Of the rays; of length 1.
    rays_of : (S,) uint32
        Ray of each sample.

    Returns
    -------
    (S, 32) real
        16 basis functions, degrees 0 to 3, then the features.
    """
    samples = features.shape[0]
    inputs = device.empty("inputs of colours", (samples, 32))
    arguments = [samples, features, directions, rays_of, inputs]
    device.launch("heads", "heads_join", (samples,), arguments, defines=DEFINES)
    return inputs


def heads_fwd(device: Device, features: Array, outputs: Array) -> tuple[Array, Array]:
    """Densities exp(features[:, 0]) and colours, the sigmoid of outputs[:, :3].

    Parameters
    ----------
    features : (S, 16) real
    outputs : (S, 16) real
        Of the network of colours; only the first three columns count.

    Returns
    -------
    sigmas : (S,) real
    colors : (S, 3) real
    """
    samples = features.shape[0]
    sigmas, colors = device.empty("sigmas", samples), device.empty("colours of samples", (samples, 3))
    arguments = [samples, features, outputs, sigmas, colors]
    device.launch("heads", "heads_fwd", (samples,), arguments, defines=DEFINES)
    return sigmas, colors


def heads_bwd(device: Device, colors: Array, v_colors: Array) -> Array:
    """Gradient of the colours of `heads_fwd` with respect to `outputs`, (S, 16), from v_colors (S, 3)."""
    samples = colors.shape[0]
    v_outputs = device.empty("v_outputs", (samples, 16))
    device.launch("heads", "heads_bwd", (samples,), [samples, colors, v_colors, v_outputs], defines=DEFINES)
    return v_outputs


def heads_join_bwd(device: Device, v_inputs: Array, features: Array, sigmas: Array, v_sigmas: Array) -> Array:
    """Gradient with respect to the features of `heads_join` and of the densities of `heads_fwd`.

    Parameters
    ----------
    v_inputs : (S, 32) real
        Gradient with respect to the result of `heads_join`.
    features : (S, 16) real
    sigmas, v_sigmas : (S,) real
        Densities, and the gradient with respect to them.

    Returns
    -------
    (S, 16) real
    """
    samples = features.shape[0]
    v_features = device.empty("v_features", (samples, 16))
    arguments = [samples, v_inputs, features, sigmas, v_sigmas, v_features]
    device.launch("heads", "heads_join_bwd", (samples,), arguments, defines=DEFINES)
    return v_features


def heads_sh_fwd(
    device: Device, features: Array, directions: Array, rays_of: Array, density_scale: float
) -> tuple[Array, Array]:
    """Densities and colours of Plenoxels (Fridovich-Keil et al. 2022, section 3.1).

    Parameters
    ----------
    features : (S, 28) or (S, 4) real
        A density, of which the positive part counts, and the coefficients of spherical harmonics of each colour: nine
        of degree 2, or one of degree 0.
    directions : (R, 3) real
        Of the rays; of length 1.
    rays_of : (S,) uint32
        Ray of each sample.
    density_scale : float
        Factor on the densities.

    Returns
    -------
    sigmas : (S,) real
    colors : (S, 3) real
        At least 0.
    """
    samples, width = features.shape
    sigmas, colors = device.empty("sigmas", samples), device.empty("colours of samples", (samples, 3))
    arguments = [samples, width // 3, float(density_scale), features, directions, rays_of, sigmas, colors]
    device.launch("heads", "heads_sh_fwd", (samples,), arguments, defines=DEFINES)
    return sigmas, colors


def heads_sh_bwd(
    device: Device,
    features: Array,
    directions: Array,
    rays_of: Array,
    density_scale: float,
    v_sigmas: Array,
    v_colors: Array,
) -> Array:
    """Gradient of `heads_sh_fwd` with respect to the features, from v_sigmas (S,) and v_colors (S, 3)."""
    samples, width = features.shape
    v_features = device.empty("v_features", features.shape)
    arguments = [
        samples,
        width // 3,
        float(density_scale),
        features,
        directions,
        rays_of,
        v_sigmas,
        v_colors,
        v_features,
    ]
    device.launch("heads", "heads_sh_bwd", (samples,), arguments, defines=DEFINES)
    return v_features


def heads_soft_fwd(device: Device, features: Array, outputs: Array, density_scale: float) -> tuple[Array, Array]:
    """Densities density_scale softplus(features[:, 0] - DENSITY_SHIFT) and colours, the sigmoid of outputs[:, :3].

    Parameters
    ----------
    features : (S, W) real
    outputs : (S, V) real
    density_scale : float
        Factor on the densities.

    Returns
    -------
    sigmas : (S,) real
    colors : (S, 3) real
    """
    samples, width = features.shape
    sigmas, colors = device.empty("sigmas", samples), device.empty("colours of samples", (samples, 3))
    scalars = [samples, width, outputs.shape[1], float(density_scale)]
    arguments = [*scalars, features, outputs, sigmas, colors]
    device.launch("heads", "heads_soft_fwd", (samples,), arguments, defines=DEFINES)
    return sigmas, colors


def heads_soft_bwd(device: Device, features: Array, density_scale: float, v_sigmas: Array, v_features: Array) -> None:
    """Add the gradient of the densities of `heads_soft_fwd`, from v_sigmas (S,), to v_features (S, W)."""
    samples, width = features.shape
    arguments = [samples, width, float(density_scale), features, v_sigmas, v_features]
    device.launch("heads", "heads_soft_bwd", (samples,), arguments, defines=DEFINES)
