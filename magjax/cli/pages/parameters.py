"""`python -m magjax.cli.pages.parameters [--check]`: docs/parameters.md, from the declared parameters and the keys of a bench file."""

import re
import sys

from magjax import bench
from magjax.chain import Coil, FieldCoil, Magnetostriction, Mechanics, Piezo, Sensor
from magjax.effects import CLASSES, forms_of
from magjax.page import deliver, extent, number, table
from magjax.param import parameters_of

GREEK = {
    "alpha": "α",
    "beta": "β",
    "chi": "χ",
    "eta": "η",
    "gamma": "γ",
    "kappa": "κ",
    "lambda": "λ",
    "mu": "μ",
    "sigma": "σ",
    "tau": "τ",
    "xi": "ξ",
    "zeta": "ζ",
}
BLOCKS = (
    ("coil", Coil, "Driven by a current, T&B (3)-(4): `H + k dB/dt = c0 I + H_bias` with `k = c0 N_m A_m / R_eddy`."),
    ("coil", FieldCoil, "Driven by a known field, where `[coil]` holds `k_eddy`: `H + k dB/dt = applied field`."),
    ("magnetostriction", Magnetostriction, "T&B (5), forcing: free displacement `l_rod lambda_s (M/M_s)^2`."),
    (
        "piezo",
        Piezo,
        "A stack under voltage, without [coil] and [magnetostriction]: `u = stroke P / V_m`, `P = Gamma[V] + chi V`, P in V; see "
        "[transducers.md](transducers.md). `P_m` stands for `stroke` where a polarization is read.",
    ),
    ("mechanics", Mechanics, "T&B (5): `y'' + 2 xi w0 y' + w0^2 y = w0^2 u`, `w0 = 2 pi f0`."),
    ("sensor", Sensor, "What the sensor adds."),
)
SETTINGS = {
    "name": "what results call the bench (default: the file's name)",
    "sensor.tau": "filter of the sensor, if it is known (data sheet, calibration): 1/(1 + s tau + order2 (s tau)^2), s; part of the base, not searched for",
    "sensor.order2": "of that filter: 0 first order (default), 1/3 Bessel, 1/2 Butterworth",
    "hysteresis.levels": "levels L of the Preisach plane that `simulate` starts from, 2 to 400 (default 25)",
    "hysteresis.start": "magnetic state before a simulation: "
    + ", ".join(f'"{s}"' for s in bench.STARTS)
    + ' (default "auto", which is "negative_saturation"; a fit tries the three; "demagnetized" with the bias on, or before it), '
    + "or a list of the fields, A/m, that led there from negative saturation, oldest first",
    "limits.current_A": "largest current, A: bounds the Preisach plane of `simulate` (by 0.9 where none is stated), what `record` may drive and what is asked for next",
    "limits.field_A_per_m": "the same for a bench that is driven by a field, A/m (300 where none is stated)",
    "limits.voltage_V": "the same for a piezo stack, V (150 where none is stated)",
    "fit.free": 'what a fit frees: "hysteresis.masses" and any "block.parameter" of the tables above (default: the masses and what of R_eddy, k_eddy, chi, xi and f0 the bench has)',
    "fit.output": "what is fitted: displacement, flux_density, magnetization, polarization or strain (default: displacement, or flux_density without [magnetostriction] and [piezo])",
    "fit.priors": "standard deviation of a free parameter about its stated value, SI, above zero, by its full name, as in `coil.R_eddy = 2.0`",
}
COLUMNS = {
    "name": "name of the column in the file (default: the quantity with its unit, such as `displacement_um`)",
    "scale": "reading = column * scale + offset, in `unit` (default 1)",
    "offset": "see `scale` (default 0)",
    "unit": "unit after scaling (default: SI)",
    "split": "under [columns.time]: a column at whose values a file is cut into recordings (loops, captures)",
    "merge": "under [columns.time]: the pieces are repeats that are not aligned; join them on one period",
    "quasistatic": "under [columns.time]: there is no time; one loop counts as one period of a second and nothing may depend on a rate",
    "emf_turns": "the column is the emf of a pick-up coil of so many turns; it is integrated to flux density",
    "emf_area": "area of that coil, m^2",
    "emf_sign": "sign of its emf, 1 or -1 (default -1)",
    "bits": "bits of the converter: what its rounding leaves is taken as uncertain however often a signal repeats",
    "gain_accuracy": "how well the scale is known from one recording to the next, relative (0.03: 3 %)",
}


def symbol(name: str) -> str:
    """The letter of an equation: Greek spelled out becomes Greek, what follows the letter a subscript; words stay words."""
    letter, _, under = name.partition("_")
    plain = re.fullmatch(r"([A-Za-z]+?)(\d+)", letter)
    if plain and not under:
        letter, under = plain.groups()
    if len(letter) > 1 and letter not in GREEK:
        return name.replace("_", " ")
    return GREEK.get(letter, letter) + (f"<sub>{under.replace('_', ' ')}</sub>" if under else "")


def rows(module, prefix: str):
    """One row a declared parameter."""
    for name, info in parameters_of(module).items():
        default = number(info.default)
        yield (
            symbol(name),
            f"`{prefix}{name}`",
            info.unit,
            info.meaning,
            default,
            extent(info.typical),
            extent((info.low, info.high)),
        )


def page() -> str:
    """Markdown: the chain's parameters by block, the effects', then every other key of a bench file."""
    head = ("symbol", "unit", "meaning", "default", "typical", "bounds")
    lines = [
        "# Parameters and the keys of a bench file", "",
        "Generated by `python -m magjax.cli.pages.parameters` from what the code declares. SI throughout. A fit stays within the bounds;",
        "`typical` is where such benches lie and limits nothing.", "",
        "## The chain", "",
        'In results a parameter is named "block.key" (`coil.R_eddy`); in a bench file its key stands under `[block]`.',
    ]  # fmt: skip
    for block, module, text in BLOCKS:
        lines += ["", f"### [{block}]{' driven by a field' if module is FieldCoil else ''}", "", text, ""]
        lines += table(("symbol", "bench key", *head[1:]), rows(module, ""))
    lines += [
        "", "## Effects", "",
        'In results a parameter is named "effects.EFFECT.PARAMETER". A bench file does not hold them: `magjax diagnose` finds them, `model.json`',
        "keeps them, and `magjax emulate --hide EFFECT:PARAMETER=VALUE` conceals them. At its null an effect is not there; a `shape` means",
        "nothing while its effect is at null. Laws and sources: [effects.md](effects.md).", "",
    ]  # fmt: skip
    body = []
    for form in (form for name in CLASSES for form in forms_of(name)):
        told = {row[1] for row in body}  # of another form
        for (mark, name, *rest), info in zip(rows(form, f"{form.name}."), form.parameters().values(), strict=True):
            if name not in told:
                body.append((mark, name, *rest[:2], "shape" if info.shape else number(info.null), *rest[2:]))
    lines += table(("symbol", "effect.parameter", "unit", "meaning", "null", "default", "typical", "bounds"), body)
    lines += ["", "## Other keys of a bench file", "", *table(("key", "meaning"), ((f"`{k}`", v) for k, v in SETTINGS.items()))]
    quantities = ", ".join(bench.QUANTITIES)
    lines += ["", "## [columns.QUANTITY]", "", f"Where a file names things otherwise. QUANTITY is one of {quantities}.", ""]
    return "\n".join([*lines, *table(("key", "meaning"), ((f"`{k}`", v) for k, v in COLUMNS.items()))]) + "\n"


def main(arguments=None) -> int:
    """Write docs/parameters.md, or with --check say whether it is up to date."""
    return deliver("parameters.md", page(), "magjax.cli.pages.parameters", arguments)


if __name__ == "__main__":
    sys.exit(main())
