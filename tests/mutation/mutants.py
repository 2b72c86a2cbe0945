"""Planted bugs, each with the tests that must fail under it. `run.py` plants them one by one."""

from typing import NamedTuple


class Mutant(NamedTuple):
    """A bug: a text that stands once in a file, what it becomes, and the tests that catch it."""

    name: str
    file: str
    old: str
    new: str
    tests: str  # arguments of pytest


def _of(file: str, tests: str, *bugs: tuple[str, str, str]) -> list[Mutant]:
    return [Mutant(name, f"rp_jax/{file}", old, new, tests) for name, old, new in bugs]


MUTANTS = [
    *_of(
        "shield.py",
        "tests/test_shield.py",
        (
            "a threat of exactly x is refused",
            "allowed = threat <= narrowed",
            "allowed = threat < narrowed",
        ),
        ("the most threatening fallback", "jnp.argmin(jnp.where(", "jnp.argmax(jnp.where("),
        (
            "nan is the least threat",
            "jnp.argmin(jnp.where(jnp.isnan(threat), jnp.inf, threat))",
            "jnp.argmin(threat)",
        ),
        ("rounding to nearest", "np.where(above < threat, np.next", "np.where(False, np.next"),
        ("no flush of subnormals", "(above > 0) & (above < tiny)", "(above > 0) & (above < 0)"),
        (
            "values below 0 lose to the mask",
            "admissible, values, -jnp.inf))",
            "admissible, values, 0.0))",
        ),
        ("random action off by one", "jnp.argmax(rank > chosen)", "jnp.argmax(rank >= chosen)"),
        (
            "the mask is left out of a correction",
            "masked_argmax(scores, mask)",
            "masked_argmax(scores, mask | True)",
        ),
    ),
    *_of(
        "planning/dqn.py",
        "tests/planning/test_dqn.py",
        (
            "target over all actions",
            "shield.masked_argmax(online, admissible)",
            "jnp.argmax(online)",
        ),
        (
            "target network chooses too",
            "masked_argmax(online, admissible)",
            "masked_argmax(target, admissible)",
        ),
        ("no Double Q", "target[shield.masked_argmax", "online[shield.masked_argmax"),
        ("rewards not scaled", "batch.reward * config.reward_scale", "batch.reward"),
        ("weights of the replay ignored", "jnp.mean(weights * optax", "jnp.mean(optax"),
        (
            "the target network is the network",
            "optax.incremental_update(params, learner.target, config.polyak)",
            "params",
        ),
    ),
    *_of(
        "planning/nstep.py",
        "tests/planning/test_nstep.py",
        (
            "a time limit is a terminal state",
            "jnp.where(window.terminated[last], 0.0",
            "jnp.where(window.done[last], 0.0",
        ),
        (
            "a terminal state is none",
            "jnp.where(window.terminated[last], 0.0",
            "jnp.where(False, 0.0",
        ),
        ("the window runs over an end", "- window.done == 0", "- window.done <= 1"),
        ("discount one power short", "gamma * powers[last])", "powers[last])"),
        ("mask of the first state", "window.next_admissible[last]", "window.next_admissible[0]"),
    ),
    *_of(
        "planning/loop.py",
        "tests/planning/test_loop.py tests/planning/test_q_probes.py",
        (
            "exploration outside the set",
            "masked_choice(pick, admissible)",
            "masked_choice(pick, admissible | True)",
        ),
        (
            "the mask of s for s'",
            "next_admissible=seen.admissible,",
            "next_admissible=state.seen.admissible,",
        ),
        ("danger is rewarded", "outcome.reward - pmdp.penalty", "outcome.reward + pmdp.penalty"),
        ("crashes are insecure too", "~seen.secure & ~outcome.terminated", "~seen.secure"),
        ("the window forgets the new step", "[old[1:], new[None]]", "[old[1:], old[:1]]"),
        ("exploration never falls", "done * (config.explore_to", "0 * (config.explore_to"),
        (
            "acting keys shared by the batch",
            "keys = jax.random.split(choose_key, batch)",
            "keys = jnp.broadcast_to(choose_key, (batch,))",
        ),
    ),
    *_of(
        "planning/pmdp.py",
        "tests/planning/test_pmdp.py",
        ("the worst plan", "best = jnp.min(static, axis=1)", "best = jnp.max(static, axis=1)"),
        (
            "fixed hazards alone under plans",
            "static = static + moving.reshape",
            "static = static + 0 * moving.reshape",
        ),
        (
            "life after a crash in the backup",
            "going = flat(~outcome.done)",
            "going = flat(~outcome.done) | True",
        ),
        (
            "the backup forgets the step's danger",
            "flat(outcome.danger) + least",
            "0 * flat(outcome.danger) + least",
        ),
        (
            "look-ahead where it is not needed",
            "insecure = ~jnp.any(summed <= level",
            "insecure = jnp.any(summed <= level",
        ),
    ),
    *_of(
        "threat/total.py",
        "tests/threat",
        (
            "the last hazard of a call is skipped",
            "jnp.arange(CHUNK) < count",
            "jnp.arange(CHUNK) < count - 1",
        ),
        ("every second call is skipped", "start + CHUNK, total.at", "start + 2 * CHUNK, total.at"),
        (
            "one kind of hazard is skipped",
            "for kind in sorted(hazards)]\n    total",
            "for kind in sorted(hazards)[:1]]\n    total",
        ),
        ("hazards that are absent count", "return reached & hazards.present", "return reached"),
        (
            "the sum is not rounded up",
            "return total * (1 + (terms + 1) * float(jnp.finfo(total.dtype).eps))",
            "return total",
        ),
    ),
    *_of(
        "threat/static.py",
        "tests/threat/test_static.py tests/planning/test_pmdp.py",
        ("no margin at walls", "jnp.where(clearance >= MARGIN", "jnp.where(clearance >= 0"),
        (
            "only the end of a plan is looked at",
            "jnp.minimum(least, clearance(us.position))",
            "clearance(us.position)",
        ),
    ),
    *_of(
        "threat/model.py",
        "tests/threat/test_model.py tests/threat/test_calibration.py",
        (
            "a shift that breaks the order",
            "jnp.where(fitted <= self.knee, fitted + self.shift, fading)",
            "jnp.where(fitted <= self.knee, fitted + self.shift, fitted)",
        ),
    ),
    *_of(
        "threat/fit.py",
        "tests/threat",
        (
            "mirror images keep their actions",
            "swapped = data.threat[:, sub.body.mirrored_threats()]",
            "swapped = data.threat",
        ),
        (
            "validation on training states",
            "part(order[held:]), part(order[:held])",
            "part(order[held:]), part(order[held:])",
        ),
    ),
    *_of(
        "threat/build.py",
        "tests/threat/test_calibration.py",
        ("calibration off by one", "float(needed[allowed])", "float(needed[allowed + 1])"),
        (
            "one miss more than allowed",
            "max(0, statistics.events_allowed(n, rate, confidence))",
            "1 + max(0, statistics.events_allowed(n, rate, confidence))",
        ),
    ),
    *_of(
        "recon/labels.py",
        "tests/recon",
        ("exact horizon one step short", "if k == source.horizon:", "if k >= source.horizon - 1:"),
        (
            "exact labels lose a discount",
            "jax.vmap(first)(model.actions) * sub.beta",
            "jax.vmap(first)(model.actions)",
        ),
        (
            "a hit at the start is none",
            "threat = jnp.where(source.hits(body, hazard), 1.0, threat)",
            "threat = jnp.where(False, 1.0, threat)",
        ),
        (
            "the last hit counts",
            "now = source.hits(us, other) & ~hit",
            "now = source.hits(us, other)",
        ),
        ("two steps share their noise", "lambda n: n[1:], noise)", "lambda n: n[:-1], noise)"),
        (
            "body and hazard share a key",
            "ours, theirs = jax.random.split(key)",
            "ours = theirs = key",
        ),
        (
            "all rows share a key",
            "keys = jax.random.split(key, count)",
            "keys = jnp.broadcast_to(key, (count,))",
        ),
        (
            "hazards stand still",
            "other = source.step(other, us, noise)",
            "other = jax.tree.map(jnp.asarray, other)",
        ),
    ),
    *_of(
        "hazards/wall_point.py",
        "tests/hazards tests/recon",
        (
            "window without the radius",
            "box(speed).padded(self.radius + MARGIN)",
            "box(speed).padded(0 * self.radius)",
        ),
        (
            "mirror forgets a sign",
            "jnp.asarray([1.0, -1.0, 1.0], features",
            "jnp.asarray([1.0, 1.0, 1.0], features",
        ),
    ),
    *_of(
        "hazards/moving_obstacle.py",
        "tests/hazards tests/recon",
        (
            "window of an obstacle that does not speed up",
            "other + self.drift)",
            "other + 0 * self.drift)",
        ),
        (
            "features swap the speeds",
            "jnp.stack([hazard.speed, body.speed])",
            "jnp.stack([body.speed, hazard.speed])",
        ),
    ),
    *_of(
        "dynamics/vehicle.py",
        "tests/dynamics tests/envs/test_golden.py",
        (
            "a vehicle moves along its new heading",
            "moving = vehicle if delayed else changed",
            "moving = changed",
        ),
    ),
    *_of(
        "envs/contract.py",
        "tests/envs",
        ("time limit one step late", "(time >= time_limit)", "(time > time_limit)"),
        (
            "terminated and truncated at once",
            "(time >= time_limit) & ~terminated",
            "(time >= time_limit)",
        ),
        (
            "a hazard that is absent is hit",
            "group.state) & group.present",
            "group.state) | ~group.present",
        ),
    ),
    *_of(
        "envs/autoreset.py",
        "tests/envs/test_autoreset.py",
        ("starts drawn with the step's key", "both.at[rows, 1]", "both.at[rows, 0]"),
        (
            "truncated episodes go on",
            "replace_rows(outcome.done, seen",
            "replace_rows(outcome.terminated, seen",
        ),
    ),
    *_of(
        "envs/tally.py",
        "tests/envs/test_tally.py",
        (
            "sums leak into the next episode",
            "jnp.where(outcome.done, 0.0, a), total)",
            "jnp.where(outcome.terminated, 0.0, a), total)",
        ),
    ),
    *_of(
        "envs/circuit.py",
        "tests/envs/test_golden.py tests/envs/test_circuit.py",
        (
            "laps backwards earn",
            "jnp.abs(passed) >= n // 4, 0, passed)",
            "jnp.abs(passed) >= n, 0, passed)",
        ),
    ),
    *_of(
        "envs/jam.py",
        "tests/envs/test_golden.py tests/envs/test_jam.py",
        ("walls cannot be hit", 'hit["wall"] | hit["obstacle"]', 'hit["obstacle"]'),
        (
            "the goal after a crash",
            "goal = goal & ~crashed",
            "goal = goal | crashed",
        ),
    ),
    *_of(
        "rollout.py",
        "tests/test_rollout.py tests/test_evaluation.py",
        (
            "every step has the same key",
            "now = jax.vmap(jax.random.fold_in, (0, None))(keys, time)",
            "now = keys",
        ),
        (
            "ended episodes are stepped on",
            "kept = jax.vmap(select)(moved, reached, states)",
            "kept = reached",
        ),
    ),
    *_of(
        "evaluation.py",
        "tests/test_evaluation.py",
        ("steps after the end count", "return jax.vmap(select)(moved, sums, rows)", "return sums"),
        (
            "returns without the penalty",
            "returns = rows.score - penalty * rows.danger",
            "returns = rows.score",
        ),
        (
            "crashes below a danger of 1",
            "int((rows.danger > 0).sum())",
            "int((rows.danger > 1).sum())",
        ),
        (
            "starts of one key",
            "start_key, play_key = jax.random.split(key)",
            "start_key = play_key = key",
        ),
        (
            "one-sided bound for two-sided",
            "statistics.clopper_pearson(k, n)",
            "statistics.clopper_pearson(k, n, 0.9)",
        ),
    ),
    *_of(
        "statistics.py",
        "tests/test_statistics.py",
        (
            "upper end of an interval off by one",
            "stats.beta.ppf(1 - tail, k + 1, n - k)",
            "stats.beta.ppf(1 - tail, k, n - k + 1)",
        ),
        (
            "upper bound at another level",
            "stats.beta.ppf(confidence, k + 1, n - k)",
            "stats.beta.ppf(confidence - 0.01, k + 1, n - k)",
        ),
        (
            "one event too many is allowed",
            "upper_bound(k, n, confidence) > rate",
            "upper_bound(max(k - 1, 0), n, confidence) > rate",
        ),
        ("tests too short", "return high\n\n\ndef events", "return low\n\n\ndef events"),
        ("normal in place of Student", "values.std(ddof=1)", "values.std(ddof=0)"),
    ),
    *_of(
        "streams.py",
        "tests/test_streams.py",
        ("certificates on the episodes of evaluation", "CERTIFICATE = 6", "CERTIFICATE = 3"),
        (
            "learning and evaluation share a stream",
            "jax.random.fold_in(key, int(stream))",
            "jax.random.fold_in(key, 0)",
        ),
    ),
    *_of(
        "runs/certify.py",
        "tests/runs/test_certify.py",
        (
            "one crash more than planned",
            "shows = crashes <= allowed",
            "shows = crashes <= allowed + 1",
        ),
        (
            "rounds share their key",
            "play(jax.random.fold_in(own, i)",
            "play(jax.random.fold_in(own, 0)",
        ),
        (
            "more episodes than planned",
            "np.asarray(found.danger)[: n - done]",
            "np.asarray(found.danger)",
        ),
    ),
    *_of(
        "rare.py",
        "tests/test_rare.py",
        (
            "paths drawn whether they got there or not",
            "odds = paths.reached / ",
            "odds = jnp.ones_like(paths.reached) / ",
        ),
        ("the last level is left out", "float(np.prod(rates))", "float(np.prod(rates[:-1]))"),
        ("danger after the first crash", "crashed=paths.crashed | crashed,", "crashed=crashed,"),
    ),
    *_of(
        "checkpoints.py",
        "tests/test_checkpoints.py",
        (
            "a step is lost on resume",
            "for i in range(done, length):",
            "for i in range(done + (done > 0), length):",
        ),
        (
            "another run's checkpoint is taken",
            '(about.get("run"), about.get("of")) == (self.run, length)',
            '(about.get("of")) == (length)',
        ),
    ),
    *_of(
        "storage.py",
        "tests/test_storage.py",
        (
            "a damaged manifest is believed",
            'if manifest.get("seal") != manifest_checksum(manifest):',
            "if False:",
        ),
        (
            "damaged arrays are believed",
            "if hashlib.sha256(data).hexdigest() != sha256:",
            "if False:",
        ),
    ),
    *_of(
        "tabular/thresholds.py",
        "tests/tabular",
        (
            "a threshold larger than the theorem's",
            "PAPER, TIGHT = 2.0, 1.0",
            "PAPER, TIGHT = 2.0, 0.9",
        ),
        (
            "a certificate without model error",
            "room, 0.0)[..., None] + excess",
            "room, 0.0)[..., None] + 0 * excess",
        ),
        (
            "danger of the policy for that of greedy-eta",
            "corollary_1(cmdp, greedy(threat(cmdp, policy).action), c, factor)",
            "corollary_1(cmdp, policy, c, factor)",
        ),
        ("a horizon one step short", "jnp.expm1(horizon * jnp", "jnp.expm1((horizon - 1) * jnp"),
        (
            "the least threat of the same step",
            "jnp.append(least[1:], 0 * least[:1], axis=0)",
            "least",
        ),
    ),
    *_of(
        "tabular/secure.py",
        "tests/tabular",
        (
            "threats of the first step for all",
            "jax.vmap(over_states)(action_threat, x)",
            "jax.vmap(over_states)(jnp.broadcast_to(action_threat[:1], action_threat.shape), x)",
        ),
        ("secure at some time", "axis=0)  # (S, A)", "axis=0) | each.admissible[0]  # (S, A)"),
    ),
    *_of(
        "tabular/qlearning.py",
        "tests/tabular",
        (
            "Q-learning bootstraps from outside the set",
            "masked_argmax(learner.values[after, arrival], admissible[after, arrival])",
            "masked_argmax(learner.values[after, arrival], admissible[after, arrival] | True)",
        ),
        (
            "Q-learning goes on after the end",
            "ahead = jnp.where(last, 0.0,",
            "ahead = jnp.where(False, 0.0,",
        ),
    ),
    *_of(
        "baselines/actor_critic.py",
        "tests/baselines/test_actor_critic.py",
        ("advantages leak over an end", "trace * jnp.where(ended, 0.0, ahead)", "trace * ahead"),
    ),
    *_of(
        "baselines/pid_lagrangian.py",
        "tests/baselines/test_pid_lagrangian.py",
        (
            "the integral may become negative",
            "jnp.maximum(controller.integral + error, 0.0)",
            "controller.integral + error",
        ),
    ),
    *_of(
        "planning/wrapped.py",
        "tests/planning/test_conditioned.py",
        (
            "thresholds drawn alike, not their logarithms",
            "level = jnp.exp(low + jax.random.uniform(key, (), low.dtype) * (high - low))",
            "level = params.low + jax.random.uniform(key, ()) * (params.high - params.low)",
        ),
    ),
    *_of(
        "adapters/gymnasium.py",
        "tests/adapters/test_gymnasium.py",
        (
            "the shield lets the wish pass",
            "chosen = _correct(threat, wish, self._threshold(threat)",
            "chosen = _correct(0 * threat, wish, self._threshold(threat)",
        ),
    ),
]
