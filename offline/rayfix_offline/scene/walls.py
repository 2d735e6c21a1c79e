"""Walls: what each triangle of a scene reflects and lets through, from the site file and the scene's materials."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.scene.materials import (
    ReflectionSettings,
    complex_permittivity,
    fresnel_power,
    itu_name,
    plain_name,
    with_conductivity,
)
from rayfix_offline.scene.scene import Scene
from rayfix_offline.scene.slabs import excess_length, slab_power
from rayfix_offline.site import MaterialSection, SiteFile


@dataclass(frozen=True, kw_only=True, eq=False)
class Walls:
    """Reflection and transmission of each triangle.

    Attributes
    ----------
    permittivity : ndarray of complex, shape (n_faces,)
        Complex relative permittivity; NaN where it is not known.
    thickness : ndarray of shape (n_faces,), m
        Thickness of the wall if the triangle is part of a sheet; NaN where it is not known or nothing passes.
    reflection_loss_db, transmission_loss_db : ndarray of shape (n_faces,)
        NaN where permittivity and thickness decide; a transmission loss of infinity where nothing passes.
    solid : ndarray of int32, shape (n_faces,)
        Index of the closed part that the triangle belongs to; -1 for a sheet.
    outward : ndarray of shape (n_faces, 3)
        Unit normals, of solids the outward ones.
    carrier_ghz : float
    excess_length : bool
        Whether a slab adds to the length of the paths that pass it.
    """

    permittivity: NDArray[np.complex128]
    thickness: NDArray[np.float64]
    reflection_loss_db: NDArray[np.float64]
    transmission_loss_db: NDArray[np.float64]
    solid: NDArray[np.int32]
    outward: NDArray[np.float64]
    carrier_ghz: float
    excess_length: bool = True
    settings: ReflectionSettings = field(default_factory=ReflectionSettings)

    @property
    def passable(self) -> NDArray[np.bool_]:
        """Whether signals pass each triangle, shape (n_faces,)."""
        return np.asarray(self.transmission_loss_db != np.inf)

    def reflected(
        self,
        faces: NDArray[np.int32],
        cos_incidence: NDArray[np.float64],
        thickness: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """Logarithm to base 10 of the reflected fraction of the power.

        Parameters
        ----------
        faces : ndarray of int, shape (n,)
        cos_incidence : ndarray of shape (n,)
            Cosine of the angle between ray and normal, in [0, 1].
        thickness : ndarray of shape (n,), optional, m
            Of the walls; NaN where they are half spaces. Those of sheets when left out.
        """
        thickness = self.thickness[faces] if thickness is None else thickness
        permittivity, loss = self.permittivity[faces], self.reflection_loss_db[faces]
        out = -0.1 * loss
        computed = np.isnan(loss)
        power = np.zeros(len(faces))
        half = computed & np.isnan(thickness)
        slab = computed & ~half
        power[half] = fresnel_power(
            cos_incidence[half], permittivity[half], grazing_cosine=self.settings.grazing_cosine
        )
        power[slab] = self._slab(cos_incidence[slab], permittivity[slab], thickness[slab])[0]
        out[computed] = np.log10(np.maximum(power[computed], self.settings.min_power))
        return np.asarray(out)

    def transmitted(
        self, faces: NDArray[np.int32], cos_incidence: NDArray[np.float64], thickness: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Logarithm to base 10 of the fraction of the power that passes, and the excess length, m.

        Parameters as those of :meth:`reflected`. The logarithm is minus infinity where nothing passes.
        """
        permittivity, loss = self.permittivity[faces], self.transmission_loss_db[faces]
        out = -0.1 * loss
        slab = np.isnan(loss)
        power = self._slab(cos_incidence[slab], permittivity[slab], thickness[slab])[1]
        out[slab] = np.log10(np.maximum(power, self.settings.min_power))
        excess = np.zeros(len(faces))
        if self.excess_length:
            known = np.isfinite(permittivity) & np.isfinite(thickness)
            excess[known] = excess_length(cos_incidence[known], permittivity[known], thickness[known])
        return np.asarray(out), excess

    def _slab(
        self, cosine: NDArray[np.float64], permittivity: NDArray[np.complex128], thickness: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return slab_power(
            cosine,
            permittivity,
            thickness,
            carrier_ghz=self.carrier_ghz,
            grazing_cosine=self.settings.grazing_cosine,
        )


def opaque_walls(num_faces: int, *, loss_db: float) -> Walls:
    """Return triangles that let nothing through and all reflect with the same loss."""
    return Walls(
        permittivity=np.full(num_faces, np.nan, np.complex128),
        thickness=np.full(num_faces, np.nan),
        reflection_loss_db=np.full(num_faces, loss_db),
        transmission_loss_db=np.full(num_faces, np.inf),
        solid=np.full(num_faces, -1, np.int32),
        outward=np.zeros((num_faces, 3)),
        carrier_ghz=1.0,
    )


def walls_of(
    site: SiteFile,
    scene: Scene,
    solid: NDArray[np.int32],
    outward: NDArray[np.float64],
    settings: ReflectionSettings | None = None,
) -> Walls:
    """Resolve the materials of a scene's triangles.

    Parameters
    ----------
    solid, outward
        As in :class:`Walls`.
    """
    stated = np.full(len(scene.faces), np.nan) if scene.face_thickness is None else scene.face_thickness
    rows = [_Material.of(site, name) for name in scene.materials]
    # The last entry is that of index -1.
    rows.append(_Material.of(site, None))
    own = scene.face_materials
    permittivity = np.array([row.permittivity for row in rows], np.complex128)[own]
    given = np.array([row.thickness for row in rows])[own]
    thickness = np.where(np.isnan(given), stated, given)
    transmission_loss = np.array([row.transmission_loss_db for row in rows])[own]
    # A slab needs both of its numbers.
    transmission_loss[np.isnan(transmission_loss) & ~(np.isfinite(permittivity) & np.isfinite(thickness))] = np.inf
    return Walls(
        permittivity=permittivity,
        thickness=np.where(np.isinf(transmission_loss), np.nan, thickness),
        reflection_loss_db=np.array([row.reflection_loss_db for row in rows])[own],
        transmission_loss_db=transmission_loss,
        solid=solid,
        outward=outward,
        carrier_ghz=site.propagation.carrier_ghz,
        excess_length=site.propagation.excess_length,
        settings=settings or ReflectionSettings(),
    )


def section_of(site: SiteFile, name: str) -> str | None:
    """Name of the section of the site file about a material of the scene, None without one; exact names go first."""
    if name in site.materials:
        return name
    return next((key for key in site.materials if plain_name(key) == plain_name(name)), None)


@dataclass(frozen=True, kw_only=True)
class _Material:
    """A material as site file and tables of materials give it; fields as in :class:`Walls`."""

    permittivity: complex = complex(np.nan, 0.0)
    thickness: float = np.nan
    reflection_loss_db: float
    transmission_loss_db: float = np.inf

    @classmethod
    def of(cls, site: SiteFile, name: str | None) -> "_Material":
        """Return a material of the scene, or with None what has no material."""
        propagation = site.propagation
        if name is None:
            return cls(reflection_loss_db=propagation.reflection_loss_db)
        key = section_of(site, name)
        section = site.materials[key] if key is not None else MaterialSection()
        described = {"itu", "permittivity", "thickness_m"} & section.model_fields_set
        permittivity = None
        if propagation.reflection == "itu" or described:
            permittivity = _permittivity(section, key or name, propagation.carrier_ghz)
        reflection_loss = section.reflection_loss_db
        if reflection_loss is None:
            reflection_loss = propagation.reflection_loss_db if permittivity is None else np.nan
        transmission_loss = section.transmission_loss_db
        if not propagation.transmission:
            transmission_loss = np.inf
        elif transmission_loss is None:
            transmission_loss = np.inf if _is_metal(section, key or name) else np.nan
        return cls(
            permittivity=complex(np.nan, 0.0) if permittivity is None else permittivity,
            thickness=np.nan if section.thickness_m is None else section.thickness_m,
            reflection_loss_db=reflection_loss,
            transmission_loss_db=transmission_loss,
        )


def _permittivity(section: MaterialSection, name: str, carrier_ghz: float) -> complex | None:
    if section.permittivity is not None:
        return with_conductivity(section.permittivity, section.conductivity_s_m or 0.0, carrier_ghz)
    return complex_permittivity(section.itu or name, carrier_ghz)


def _is_metal(section: MaterialSection, name: str) -> bool:
    return section.permittivity is None and itu_name(section.itu or name) == "metal"
