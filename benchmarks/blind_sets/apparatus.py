"""What the sets are about: declared models as MJCF text, and where each joint is excited."""

import dataclasses

import mujoco
import numpy as np

from nerf2real.suite.op3 import constants

KINDS = ("pendulum", "arm", "op3")

# The servo that all apparatuses declare: XM430 in position mode (public OP3 descriptions).
GAIN, DAMPING, ARMATURE, FRICTION, LIMIT = 21.1, 1.084, 0.045, 0.03, 4.1
_JOINT = f'damping="{DAMPING}" armature="{ARMATURE}" frictionloss="{FRICTION}"'
_HEAD = '<option timestep="0.001" integrator="implicitfast"/>'


@dataclasses.dataclass(frozen=True)
class Apparatus:
  """A declared model and its excitation. J joints."""

  kind: str
  xml: str
  center: np.ndarray
  """[J] rad, middle of the training excitation."""
  amplitude: np.ndarray
  """[J] rad, of the training excitation."""
  duration: float
  """s, of each log."""
  step: float
  """s, of the plant's integrator."""

  @property
  def model(self) -> mujoco.MjModel:
    """The declared model, compiled."""
    return mujoco.MjModel.from_xml_string(self.xml)


def make_apparatus(kind: str, rng: np.random.Generator) -> Apparatus:
  """Draws an apparatus of a kind in `KINDS`."""
  if kind == "pendulum":
    return _pendulum(rng)
  if kind == "arm":
    return _arm(rng)
  if kind == "op3":
    return _op3(rng)
  raise ValueError(f"Unknown apparatus {kind!r}: expected one of {', '.join(KINDS)}.")


def _document(name: str, bodies: str, joints: list[str], gain: float) -> str:
  servos = "\n    ".join(
    f'<position name="{joint}" joint="{joint}" kp="{gain:g}" forcerange="-{LIMIT} {LIMIT}"/>'
    for joint in joints
  )
  return f"""<mujoco model="{name}">
  {_HEAD}
  <compiler angle="radian"/>
  <worldbody>
{bodies}
  </worldbody>
  <actuator>
    {servos}
  </actuator>
</mujoco>
"""


def _pendulum(rng: np.random.Generator) -> Apparatus:
  length, mass = rng.uniform(0.1, 0.18), rng.uniform(0.3, 0.65)
  gain = float(rng.choice([GAIN, GAIN, 15.8, 26.4]))
  body = f"""    <body name="arm" pos="0 0 0.5">
      <joint name="joint" type="hinge" axis="0 1 0" {_JOINT}/>
      <inertial pos="0 0 {-length:.4f}" mass="{mass:.4f}" diaginertia="1e-4 1e-4 1e-4"/>
    </body>"""
  return Apparatus(
    "pendulum",
    _document("xm430_pendulum", body, ["joint"], gain),
    rng.uniform(-0.3, 0.3, 1),
    rng.uniform(0.9, 1.3, 1),
    16.0,
    2e-4,
  )


def _arm(rng: np.random.Generator) -> Apparatus:
  """Two or three joints in chain; the axes are drawn, so some arms are planar and some are not."""
  names = ["shoulder", "elbow", "wrist"][: int(rng.integers(2, 4))]
  text, close, above = "", "", 0.8
  for index, name in enumerate(names):
    axis = "0 1 0" if index == 0 else str(rng.choice(["0 1 0", "1 0 0"]))
    length, mass = rng.uniform(0.08, 0.13), rng.uniform(0.08, 0.2)
    thick = 0.1 * mass * length**2
    indent = "  " * (index + 2)
    text += f"""{indent}<body name="{name}_link" pos="0 0 {above:.4f}">
{indent}  <joint name="{name}" type="hinge" axis="{axis}" {_JOINT}/>
{indent}  <inertial pos="0 {rng.uniform(-0.01, 0.01):.4f} {-0.6 * length:.4f}" mass="{mass:.4f}" """
    text += f'diaginertia="{thick:.3e} {thick:.3e} {0.3 * thick:.3e}"/>\n'
    close = f"{indent}</body>\n" + close
    above = -length
  count = len(names)
  return Apparatus(
    "arm",
    _document("servo_arm", text + close.rstrip("\n"), names, GAIN),
    rng.uniform(-0.4, 0.4, count),
    rng.uniform(0.5, 0.9, count),
    14.0,
    2e-4,
  )


def _op3(rng: np.random.Generator) -> Apparatus:
  """The OP3 with its torso on a stand: kinematics and inertias of the suite's link table."""
  links = constants.read_links()

  def body(link: constants.Link, indent: str) -> str:
    position = (0.0, 0.0, 0.6) if link.parent == "world" else link.position
    joint = ""
    if link.joint != "free":
      joint = f'{indent}  <joint name="{link.joint}" axis="{_numbers(link.axis)}" {_JOINT}/>\n'
    inner = "".join(body(child, indent + "  ") for child in links if child.parent == link.name)
    return (
      f'{indent}<body name="{link.name}" pos="{_numbers(position)}">\n'
      f'{indent}  <inertial pos="{_numbers(link.center)}" quat="{_numbers(link.inertia_quat)}" '
      f'mass="{link.mass:g}" diaginertia="{_numbers(link.inertia)}"/>\n'
      f"{joint}{inner}{indent}</body>\n"
    )

  (torso,) = [link for link in links if link.parent == "world"]
  joints = list(constants.JOINT_NAMES)
  xml = _document("op3_on_stand", body(torso, "    ").rstrip("\n"), joints, GAIN)
  center = np.clip(constants.REFERENCE_POSE, constants.LOWER_LIMITS, constants.UPPER_LIMITS)
  # The tree's order, which is not that of the table, is the order of the logs' columns.
  model = mujoco.MjModel.from_xml_string(xml)
  order = [joints.index(model.joint(index).name) for index in range(model.njnt)]
  ordered = [joints[index] for index in order]
  return Apparatus(
    "op3",
    _document("op3_on_stand", body(torso, "    ").rstrip("\n"), ordered, GAIN),
    center[order] + rng.uniform(-0.05, 0.05, 20),
    rng.uniform(0.18, 0.28, 20),
    12.0,
    2.5e-4,
  )


def _numbers(values) -> str:
  return " ".join(f"{value:g}" for value in values)
