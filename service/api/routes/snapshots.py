"""Windows over HTTP, the latest one or one that was recorded: correlations and spectra beside theory, and orbits."""

from typing import Annotated, Any

from fastapi import FastAPI, HTTPException, Query, Request
from fastapi.responses import JSONResponse, Response

from rotorwatch.records.snapshots import CorrelationSnapshot, OrbitSnapshot, SpectrumSnapshot, Units
from service.access.guard import Guard
from service.access.problems import problem_answer, responses
from service.analysis.snapshots.channels import SnapshotError
from service.analysis.snapshots.orbit import MOST_REVOLUTIONS
from service.api.answers import WindowAnswers
from service.api.samples import ChosenWindow, SampleReader
from service.api.views import PLACE, MachineName, ServiceView, SiteName, found_machine

_NONE: list[str] = []

_First = Annotated[list[str], Query(max_length=64, description="channel i of a pair, by name; may be repeated")]
_Second = Annotated[
    list[str],
    Query(max_length=64, description="channel j of each pair, as many as of `first`; left out, each with itself"),
]
_Channels = Annotated[list[str], Query(alias="channel", max_length=64, description="by name; may be repeated")]
_Units = Annotated[Units, Query(description="of the values: the channels' own, or SI")]
_Revolutions = Annotated[
    int, Query(ge=0, le=MOST_REVOLUTIONS, description="newest revolutions to show sample by sample as well")
]


def add_snapshot_routes(app: FastAPI, service: ServiceView, reader: SampleReader, guard: Guard) -> None:
    """Add the routes."""

    @app.exception_handler(SnapshotError)
    async def refused(request: Request, error: Exception) -> JSONResponse:
        return problem_answer(request, 422, str(error))

    common: dict[str, Any] = {"tags": ["snapshots"], "dependencies": [guard.read]}
    answers = WindowAnswers()

    @app.get(
        f"{PLACE}/correlations",
        responses=responses(CorrelationSnapshot, 404, 422),
        response_model=CorrelationSnapshot,
        **common,
    )
    def correlations(
        site: SiteName,
        machine: MachineName,
        chosen: ChosenWindow,
        first: _First = _NONE,
        second: _Second = _NONE,
        units: _Units = "channel",
    ) -> Response:
        """Correlation functions of the latest window, or one that was recorded, and theory; a few pairs by default."""
        shown, data = reader.window(found_machine(service, site, machine), chosen)
        asked = ("correlations", site, machine, chosen, tuple(first), tuple(second), units)
        return answers.of(asked, data, lambda: shown.correlations(data, first, second, units))

    @app.get(
        f"{PLACE}/spectra", responses=responses(SpectrumSnapshot, 404, 422), response_model=SpectrumSnapshot, **common
    )
    def spectra(
        site: SiteName,
        machine: MachineName,
        chosen: ChosenWindow,
        channel: _Channels = _NONE,
        first: _First = _NONE,
        second: _Second = _NONE,
        from_hz: Annotated[float | None, Query(ge=0, le=1e6, description="only frequencies from here on")] = None,
        to_hz: Annotated[float | None, Query(ge=0, le=1e6, description="only frequencies up to here")] = None,
        units: _Units = "channel",
    ) -> Response:
        """Power spectral densities of the latest window, or one that was recorded, cross-spectra, and theory."""
        view = found_machine(service, site, machine)
        band = None if from_hz is None and to_hz is None else (from_hz or 0.0, 1e6 if to_hz is None else to_hz)
        if band is not None and not band[0] < band[1]:
            raise HTTPException(422, f"to_hz: {band[1]:g} is not above from_hz {band[0]:g}")
        shown, data = reader.window(view, chosen)
        asked = ("spectra", site, machine, chosen, tuple(channel), tuple(first), tuple(second), band, units)
        return answers.of(asked, data, lambda: shown.spectra(data, channel, first, second, band, units))

    @app.get(f"{PLACE}/orbits", responses=responses(OrbitSnapshot, 404, 422), response_model=OrbitSnapshot, **common)
    def orbits(
        site: SiteName,
        machine: MachineName,
        chosen: ChosenWindow,
        revolutions: _Revolutions = 0,
        units: _Units = "channel",
    ) -> Response:
        """Orbits at running speed of the latest window, or one that was recorded, and revolutions as measured."""
        shown, data = reader.window(found_machine(service, site, machine), chosen)
        asked = ("orbits", site, machine, chosen, revolutions, units)
        return answers.of(asked, data, lambda: shown.orbits(data, revolutions, units), of_samples=revolutions > 0)
