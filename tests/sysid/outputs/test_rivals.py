"""Alternatives that the report lists."""

from types import SimpleNamespace

from nerf2real.sysid.outputs import rivals


def test_alternatives_that_predict_the_same_are_listed_first():
  kinds = [frozenset(name) for name in "abcdefgh"]
  all_of_them = [SimpleNamespace(names=names) for names in kinds]  # the likeliest first
  item = SimpleNamespace(alternatives=all_of_them, confounded=[SimpleNamespace(names=kinds[7])])
  assert [min(other.names) for other in rivals._listed(item)] == list("habcde")
