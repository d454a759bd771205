"""The catalogue of physics that T&B leave out: one file each. Adding an effect is one new file and one line here."""

from ..errors import ConfigurationError
from .accommodation import Accommodation
from .amplifier_clipping import AmplifierClipping
from .amplifier_lag import AmplifierLag
from .backlash import Backlash
from .base import AbstractEffect, Trial
from .coulomb_friction import CoulombFriction
from .creep import Creep
from .delta_e import DeltaE
from .duffing_stiffness import DuffingStiffness
from .eddy_currents import EddyCurrents
from .excess_loss import ExcessLoss
from .field_diffusion import FieldDiffusion
from .inductive_crosstalk import InductiveCrosstalk
from .linear_strain import LinearStrain
from .magnetic_aftereffect import MagneticAftereffect
from .mains_hum import MainsHum
from .mean_field import MeanField
from .quartic_magnetostriction import QuarticMagnetostriction
from .rate_dependent_switching import RateDependentSwitching
from .reversible_magnetization import ReversibleMagnetization
from .second_eddy_path import SecondEddyPath
from .second_mode import SecondMode
from .sensor_lag import SensorLag
from .sensor_nonlinearity import SensorNonlinearity
from .strain_hysteresis import StrainHysteresis
from .stress_feedback import StressFeedback
from .structural_damping import StructuralDamping
from .thermal_drift import ThermalDrift
from .transport_delay import TransportDelay
from .zero_drift import ZeroDrift

CATALOGUE = (
    AmplifierLag,
    AmplifierClipping,
    EddyCurrents,
    ExcessLoss,
    FieldDiffusion,
    SecondEddyPath,
    MeanField,
    ReversibleMagnetization,
    StressFeedback,
    MagneticAftereffect,
    Accommodation,
    RateDependentSwitching,
    QuarticMagnetostriction,
    LinearStrain,
    StrainHysteresis,
    SecondMode,
    DuffingStiffness,
    DeltaE,
    CoulombFriction,
    StructuralDamping,
    Backlash,
    Creep,
    ThermalDrift,
    SensorLag,
    TransportDelay,
    SensorNonlinearity,
    InductiveCrosstalk,
    MainsHum,
    ZeroDrift,
)

CLASSES = {effect.name: effect for effect in CATALOGUE}


def refuse_unknown(names) -> None:
    """Raises `ConfigurationError` at the first name that no effect has."""
    for name in names:
        if name not in CLASSES:
            raise ConfigurationError(f'no effect "{name}"; the catalogue has {", ".join(CLASSES)}')


def forms_of(name) -> tuple[type[AbstractEffect], ...]:
    """The forms of an effect's law, the usual one first."""
    return (CLASSES[name], *CLASSES[name].forms)


def form_of(name, keys) -> type[AbstractEffect]:
    """The form of an effect's law that has the parameters `keys`; the usual one where none has."""
    return next((form for form in forms_of(name) if set(keys) <= set(form.parameters())), CLASSES[name])


__all__ = ["CATALOGUE", "CLASSES", "AbstractEffect", "Trial", "form_of", "forms_of", "refuse_unknown"]
