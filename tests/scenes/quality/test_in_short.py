"""What a room's report says first."""

from nerf2real.scenes.quality import in_short

GOOD = {
  "held_out_views": 7,
  "held_out_psnr_db": 28.13,
  "held_out_psnr_30x40_db": 31.02,
  "sight_lines_blocked_p95_m": 0.04,
  "points_to_parts_p95_m": 0.06,
  "free_area_m2": 10.67,
  "free_area_apart_m2": 0.001,
  "passage_lacks_m": 0.17,
  "scale_source": "marker",
  "scale_spread": 0.0032,
}


def answers(figures):
  (block,) = in_short.section(figures).blocks
  return block.answers


def test_a_good_room_is_said_to_be_one():
  pictures, geometry, floor, size = answers(GOOD)
  assert pictures.answer == "28.1 dB" and "31.0 dB" in pictures.details[1]
  assert (geometry.answer, geometry.tone) == ("Yes", "good")
  assert "5 % meet matter 4 cm or more" in geometry.details[0]
  assert floor.answer == "10.7 m² of floor in one piece" and floor.details == []
  assert size.answer == "From a marker of known size" and "0.3 %" in size.details[0]


def test_metres_are_told_in_plain_centimetres():
  _, geometry, _, _ = answers({**GOOD, "sight_lines_blocked_p95_m": 1.72})
  assert "5 % meet matter 172 cm or more" in geometry.details[0]


def test_what_is_wrong_stands_out():
  figures = {
    **GOOD,
    "points_to_parts_p95_m": 0.2,
    "free_area_m2": 0.0,
    "free_area_apart_m2": 1.2,
    "scale_source": "unknown",
    "scale_spread": None,
  }
  _, geometry, floor, size = answers(figures)
  assert (geometry.answer, geometry.tone) == ("No", "warn")
  assert (floor.answer, floor.tone) == ("Nowhere", "warn")
  assert "the widest way there lacks 17 cm" in floor.details[0]
  assert (size.answer, size.tone) == ("A guess", "warn") and len(size.details) == 1


def test_floor_of_geometry_that_is_not_fit_is_no_good_news():
  _, _, floor, _ = answers({**GOOD, "sight_lines_blocked_p95_m": 0.4})
  assert floor.tone == "warn" and "Not to be trusted" in floor.details[-1]


def test_what_was_not_measured_is_left_out_or_said():
  (geometry,) = answers({"keyframes": 60})
  assert geometry.answer.startswith("Not judged") and geometry.tone == "warn"
