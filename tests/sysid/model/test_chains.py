"""What hangs on what in a model."""

import mujoco
import pytest

from nerf2real.sysid.model import chains

# an arm of two joints beside a wheel
MODEL = mujoco.MjModel.from_xml_string("""
<mujoco>
  <worldbody>
    <body name="upper"><joint name="shoulder"/><geom size="0.1"/>
      <body name="lower"><joint name="elbow"/><geom size="0.1"/>
        <body name="tool"><geom size="0.1"/></body>
      </body>
    </body>
    <body name="rim"><joint name="wheel"/><geom size="0.1"/></body>
  </worldbody>
</mujoco>""")


@pytest.mark.parametrize(
  ("body", "joints"),
  [
    ("world", []),
    ("nothing", []),
    ("upper", ["shoulder"]),
    ("lower", ["elbow", "shoulder"]),
    ("tool", ["elbow", "shoulder"]),
    ("rim", ["wheel"]),
  ],
)
def test_a_body_is_carried_by_the_joints_on_its_way(body, joints):
  assert chains.ancestors(MODEL, body) == joints


@pytest.mark.parametrize(
  ("body", "bodies"),
  [("upper", ["upper", "lower", "tool"]), ("tool", ["tool"]), ("rim", ["rim"])],
)
def test_a_body_carries_what_hangs_on_it(body, bodies):
  assert [MODEL.body(k).name for k in chains.carried(MODEL, MODEL.body(body).id)] == bodies


@pytest.mark.parametrize(
  ("joint", "chain"),
  [("shoulder", ["shoulder", "elbow"]), ("elbow", ["shoulder", "elbow"]), ("wheel", ["wheel"])],
)
def test_a_chain_is_what_carries_a_joint_and_what_it_carries(joint, chain):
  assert chains.along(MODEL, joint) == chain
