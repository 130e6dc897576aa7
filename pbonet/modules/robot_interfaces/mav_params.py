"""Parameters of a MAVLink vehicle: set, watched and listed, over its task's link."""

from typing import Annotated as A

from pbonet import InConst, InVar, OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import ParameterError
from pbonet.modules._mavlink import link_of
from pbonet.modules._mavlink_parameters import LARGEST, LONGEST, ParameterClient
from pbonet.modules._values import keep

PX4 = 12


class Wishes(Params):
    """Parameters that are read, and values that the vehicle is to have."""

    watch: A[tuple[str, ...], param("none", "parameters whose values go to PARAM")]
    want: A[str, param("none", "NAME=VALUE ... that the vehicle is to have")] = ""
    known: A[
        str,
        param(
            "none", "read: all that the vehicle reported; set all: it reports all again"
        ),
    ] = ""
    component: A[int, param("none", "that of its autopilot", ge=1, le=255)] = 1


class MavParams(PortBasedObject[Wishes], module_class="robot interface"):
    """PARAM = the vehicle's values of WATCH; WANT is set until the vehicle confirms.

    `set want NAME=VALUE ...` changes parameters of the vehicle; PARAM_LEFT is how many
    are not yet confirmed or read. `set known all` reads every parameter, and `get
    known` gives them. Whole numbers are rounded; a wish that is out of the range of the
    parameter's type is dropped, with a warning. A part of the task of `mav_vehicle`,
    after it; while the flag is up it goes on reading, and sets nothing.
    """

    system: A[int, InConst("MAV_SYS", "1", "none", "system id of the vehicle")]
    age: A[float, InVar("LINK_AGE", "1", "s", "since the last heartbeat")]
    values: A[Vector, OutVar("PARAM", "nparam", "any", "values of WATCH", new=True)]
    left: A[int, OutVar("PARAM_LEFT", "1", "none", "not yet confirmed", new=True)]

    def init(self) -> None:
        k = self.params
        if len(k.watch) != len(self.values):
            raise ParameterError(
                "WATCH has another number of names than PARAM has elements",
                expected=f"{len(self.values)} names",
                got=str(len(k.watch)),
                remedy="change NELEM of the variable, or WATCH",
            )
        if long := [one for one in k.watch if len(one) > LONGEST]:
            raise ParameterError(
                "WATCH has a name that no parameter of a vehicle can have",
                expected=f"at most {LONGEST} characters",
                got=long[0],
                remedy="correct it, as in MPC_XY_VEL_MAX",
            )
        self._link = link_of(self.task)
        self._client = ParameterClient(self._link, k.component)
        self._client.watched = k.watch
        self._wishes = wishes(k.want)

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"watch", "component"})
        self._wishes = wishes(self.params.want)
        if name == "known":
            self._client.read_all()

    def get(self, name: str) -> object:
        if name == "known":
            told = self._client.known.items()
            return " ".join(f"{one}={had.value:.9g}" for one, had in sorted(told))
        return getattr(self.params, name)

    def on(self) -> None:
        self._client.forget()

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the clock tells
        self._client.wanted = self._wishes
        self._run()

    def stable(self, dt: float) -> None:  # noqa: ARG002
        """Set nothing."""
        self._client.wanted = {}
        self._run()

    def _run(self) -> None:
        client = self._client
        for m in self._link.all_of("HEARTBEAT"):
            if m.get_srcComponent() == self.params.component:
                client.bytewise = m.autopilot == PX4
        for problem in client.run(self.task.now):
            self.task.warn(problem)
        self.left = client.left
        for k, name in enumerate(client.watched):
            if (told := client.known.get(name)) is not None:
                self.values[k] = told.value


def wishes(text: str) -> dict[str, float]:
    """Return the values of NAME=VALUE by name.

    Raises:
        ParameterError: One is not written like that.
    """
    found: dict[str, float] = {}
    for one in text.split():
        name, _, value = one.partition("=")
        try:
            found[name] = float(value)
        except ValueError:
            name = ""
        if not 0 < len(name) <= LONGEST or not abs(found[name]) <= LARGEST:
            raise ParameterError(
                "this sets no parameter of a vehicle",
                expected=f"NAME=VALUE, with a name of at most {LONGEST} characters "
                "and a number that is finite in 32 bits",
                got=one,
                remedy="correct it, as in MPC_XY_VEL_MAX=3.0",
            )
    return found
