"""The suite behind Gymnasium: `pip install 'nerf2real[gymnasium]'`.

python examples/gymnasium_env.py
"""

import gymnasium

from nerf2real.suite import gymnasium_wrapper


def main() -> None:
  """Takes half a second of random actions."""
  gymnasium_wrapper.register()
  environment = gymnasium.make("nerf2real/nerf_nav-v0", image_size=(30, 40))
  observation, _ = environment.reset(seed=0)
  environment.action_space.seed(0)
  total = 0.0
  for _ in range(20):
    action = environment.action_space.sample()
    observation, reward, terminated, truncated, _ = environment.step(action)
    total += float(reward)
    if terminated or truncated:
      break
  print(f"camera {observation['camera'].shape}, return {total:+.2f}")
  environment.close()


if __name__ == "__main__":
  main()
