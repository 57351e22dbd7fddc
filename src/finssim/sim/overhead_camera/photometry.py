"""Conversion of light to pixel values: reflection, attenuation in water, charge, noise and quantisation."""
# mypy: ignore-errors

import warp as wp


@wp.func
def fresnel(cos_near: float, cos_far: float, n_near: float, n_far: float) -> float:
    """Return the reflectance of a smooth dielectric surface for unpolarised light (Fresnel).

    R = (r_s² + r_p²) / 2;   at normal incidence ((n1 - n2) / (n1 + n2))².

    Args:
        cos_near: Cosine of the angle of incidence.
        cos_far: Cosine of the angle of refraction.
        n_near: Refractive index on the side of incidence.
        n_far: Refractive index on the other side.
    """
    r_s = (n_near * cos_near - n_far * cos_far) / (n_near * cos_near + n_far * cos_far)
    r_p = (n_far * cos_near - n_near * cos_far) / (n_far * cos_near + n_near * cos_far)
    return 0.5 * (r_s * r_s + r_p * r_p)


@wp.func
def refracted(ray: wp.vec3, normal: wp.vec3, ratio: float) -> wp.vec3:
    """Return the unit direction after refraction (paper, eq. 9), or zero for total reflection.

    Args:
        ray: Unit direction of the incident ray, any frame.
        normal: Unit normal against the ray, same frame [-].
        ratio: Refractive index on the ray's side over the index on the other side, η.
    """
    c = -wp.dot(normal, ray)
    kappa = 1.0 - ratio * ratio * (1.0 - c * c)
    if kappa <= 0.0:
        return wp.vec3(0.0)
    return ratio * ray + (ratio * c - wp.sqrt(kappa)) * normal


@wp.func
def through_water(radiance: wp.vec3, attenuation: wp.vec3, veil: wp.vec3, path: float) -> wp.vec3:
    """Return the radiance after a path through water (Beer-Lambert, with veiling light).

    L = L0 exp(-c s) + B (1 - exp(-c s))

    Radiances are relative to that of white [-].

    Args:
        radiance: L0 at the start, (red, green, blue) [-].
        attenuation: c [1/m].
        veil: B, radiance of infinitely deep water [-].
        path: s [m].
    """
    out = wp.vec3()
    for i in range(3):
        transmitted = wp.exp(-attenuation[i] * path)
        out[i] = radiance[i] * transmitted + veil[i] * (1.0 - transmitted)
    return out


@wp.struct
class SensorLevels:
    """Conversion of radiance to pixel values by an image sensor."""

    gain: float  # fraction of full scale for radiance 1 [-]
    full_well: float  # charge at full scale [electrons]
    read_noise: float  # standard deviation of the read noise [electrons]
    gamma: float  # exponent of the encoding [-]
    noisy: wp.bool  # whether there is noise


@wp.func
def digitised_charge(charge: float, noise: float, sensor: SensorLevels) -> wp.uint8:
    """Return the value that a pixel reports, 0 to 255.

    Args:
        charge: Mean charge [electrons].
        noise: A standard normal number, or zero.
        sensor: Full scale, noise and encoding.

    Note:
        Shot noise, with variance `charge` (photon transfer), is modelled as normal instead of Poisson: the two are
        alike above 20 electrons.
    """
    measured = charge + noise * wp.sqrt(charge + sensor.read_noise * sensor.read_noise)
    level = wp.clamp(measured / sensor.full_well, 0.0, 1.0)
    if sensor.gamma != 1.0:
        level = wp.pow(level, 1.0 / sensor.gamma)
    return wp.uint8(wp.floor(255.0 * level + 0.5))


@wp.kernel(enable_backward=False)
def digitise(
    radiance: wp.array2d(dtype=wp.vec3),
    first_row: int,
    first_column: int,
    sensor: SensorLevels,
    key: int,
    image: wp.array3d(dtype=wp.uint8),
):
    """Convert the radiance of a rectangle of the image to pixel values; noise depends only on the key and the
    pixel."""
    i, j = wp.tid()
    row = first_row + i
    column = first_column + j
    colour = radiance[i, j]
    if image.shape[2] == 1:
        grey = 0.299 * colour[0] + 0.587 * colour[1] + 0.114 * colour[2]
        colour = wp.vec3(grey, grey, grey)
    state = wp.rand_init(key, row * image.shape[1] + column)
    for c in range(image.shape[2]):
        noise = float(0.0)
        if sensor.noisy:
            noise = wp.randn(state)
        charge = wp.max(sensor.gain * colour[c], 0.0) * sensor.full_well
        image[row, column, c] = digitised_charge(charge, noise, sensor)


def noise_key(seed: int, time: float) -> int:
    """Return a 31-bit key of a picture's noise.

    Args:
        seed: Seed of the noise.
        time: Time of the picture [s], resolved to the microsecond.
    """
    mixed = (seed * 0x9E3779B97F4A7C15 + round(time * 1e6) * 0xC2B2AE3D27D4EB4F + 0x165667B19E3779F9) % 2**64
    for shift in (30, 27):
        mixed = (mixed ^ (mixed >> shift)) * 0xBF58476D1CE4E5B9 % 2**64
    return int((mixed ^ (mixed >> 31)) & 0x7FFFFFFF) % (2**31 - 1)
