"""Labels of drawings in the languages that offices ask for."""

from __future__ import annotations

from typing import Final, Literal

Language = Literal["en", "de", "fr", "pl", "es"]
LANGUAGES: Final = ("en", "de", "fr", "pl", "es")

_LABELS: Final[dict[str, tuple[str, str, str, str, str]]] = {
    "plan": ("Plan", "Grundriss", "Plan", "Rzut", "Planta"),
    "section": ("Section", "Schnitt", "Coupe", "Przekrój", "Sección"),
    "elevation": ("Elevation", "Abwicklung", "Élévation", "Rozwinięcie ścian", "Alzado"),
    "scale": ("scale", "Maßstab", "échelle", "skala", "escala"),
    "height": ("height", "Höhe", "hauteur", "wysokość", "altura"),
    "points": ("points", "Punkte", "points", "punkty", "puntos"),
    "slab": ("slab of", "Schicht von", "tranche de", "warstwa", "capa de"),
    "above": ("above", "über", "au-dessus de", "nad", "sobre"),
    "through": ("through", "durch", "par", "przez", "por"),
    "thickness": (
        "hatched: solid; wall thickness only where both sides were scanned",
        "schraffiert: Mauerwerk; Wandstärke nur, wo beide Seiten erfasst sind",
        "hachuré : plein ; épaisseur seulement où les deux faces ont été relevées",
        "kreskowanie: mur; grubość tylko tam, gdzie zmierzono obie strony",
        "rayado: macizo; espesor solo donde se midieron ambas caras",
    ),
    "gaps": (
        "dashed: no points (opening, or hidden)",
        "gestrichelt: keine Punkte (Öffnung oder verdeckt)",
        "tireté : aucun point (ouverture ou masqué)",
        "linia kreskowana: brak punktów (otwór lub zasłonięte)",
        "a trazos: sin puntos (hueco u oculto)",
    ),
    "metres": ("metres", "Meter", "mètres", "metry", "metros"),
    "wall": ("wall", "Wand", "mur", "ściana", "pared"),
    "floor": ("floor", "Boden", "sol", "podłoga", "suelo"),
    "ceiling": ("ceiling", "Decke", "plafond", "sufit", "techo"),
}


def label(key: str, language: Language = "en") -> str:
    """Return a label in a language.

    >>> label("section", "de")
    'Schnitt'
    """
    return _LABELS[key][LANGUAGES.index(language)]
