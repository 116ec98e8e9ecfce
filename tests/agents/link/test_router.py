"""A router of its own, which the learner joins: same guarantees, same rules for its users."""

import pytest

from nerf2real.agents.link import sessions
from nerf2real.agents.link.access import LinkError, access_control, read_users
from nerf2real.agents.supervision.training import free_port
from tests.agents.link import mini_learner
from tests.agents.link.test_faults import Learner, _act, _join, _login, _stored


@pytest.fixture
def router(tmp_path):
  """A router's endpoint, and the file of its users: the learner's first, then an actor's."""
  users = tmp_path / "users.txt"
  users.write_text("learner:one\nactor:two\n")
  endpoint = f"tcp/127.0.0.1:{free_port()}"
  session = sessions.route(endpoint, sessions.LinkSettings(security=sessions.Security(users=users)))
  yield endpoint
  session.close()


def test_everything_goes_through_a_router_and_a_killed_learner_comes_back(router, tmp_path):
  learner = Learner(tmp_path / "replay", router=router, users=_login(tmp_path, "learner:one"))
  try:
    link = _join(learner, login=_login(tmp_path, "actor:two"), resend_after=1.0, ask_timeout=0.5)
    _act(link, 5)
    assert link.drain(timeout=60)
    learner.kill()
    link.send(mini_learner.make_trajectory(link.outbox.made + 1), steps=47)  # nobody is there
    assert link.request(1) is None
    learner.start()
    _act(link, 5)
    assert link.drain(timeout=60)
    assert sorted(n for _, n in _stored(learner, tmp_path)) == list(range(1, 12))
    assert link.parameters()[0] == 1
    assert link.status()["status"]["alive"] == ["actor-1"]

    # An actor's user may not take the learner's part.
    heard = []
    other = _join(learner, "other", login=_login(tmp_path, "actor:two"))
    other._session.declare_queryable("nerf2real/ask/credit", lambda q: heard.append(q))
    other._session.declare_subscriber("nerf2real/trajectory/*", lambda s: heard.append(s))
    _act(link, 3)
    assert link.drain(timeout=60)
    assert heard == []
  finally:
    learner.kill()


def test_the_learner_needs_a_user_of_its_own(tmp_path):
  path = tmp_path / "users.txt"
  path.write_text("learner:one\n")
  with pytest.raises(LinkError, match="add a line for the actors"):
    access_control(list(read_users(path)), "p", learner="learner")
  with pytest.raises(LinkError, match="no users are set"):
    sessions.route("tcp/0.0.0.0:0", sessions.LinkSettings())
