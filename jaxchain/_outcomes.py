"""The outcomes of a run, with advice.  This module does not need JAX."""

# In the order of the codes in results.
ADVICE = {
    "successful": "",
    "quiet": (
        "Stopped early: every mass slides steadily, which is stable, and no observed value can "
        "change."
    ),
    "steady": ("Stopped early: all observed values repeat within the requested tolerance."),
    "max_steps_reached": (
        "The run used up its steps before it reached its end. Allow more (`max_steps`), loosen "
        "`rtol`, or use a larger regularization width."
    ),
    "step_too_small": (
        "The step size fell below what the time can resolve: the state diverged or became NaN, "
        "the regularization width is too small for these tolerances, or a force or friction law "
        "has a jump or corner that no step passes. Check the parameters, first for a negative "
        "damping ratio, and loosen `rtol` or enlarge the width."
    ),
    "untrusted_linear_solve": (
        "The truncated linear solve of the structured solver is not proven accurate for this step "
        "and coupling. Use the exact solve (`Rodas4(sweeps=None)`), a smaller constant step, or "
        "an adaptive controller."
    ),
    "nonfinite": (
        "The state or a value computed from it is NaN or infinite. Check the initial state and "
        "the parameters of this run; with a negative damping ratio vibration grows without bound. "
        "A force or friction law of your own must be finite and have finite derivatives."
    ),
    "solver_failed": (
        "The diffrax solver reported a failure. Loosen `rtol` or choose another solver."
    ),
    "events_accumulate": (
        "Sticking and sliding alternate without progress in time. Please report the parameters "
        "and the state; a small change of either may help."
    ),
    "interrupted": "The ensemble was interrupted before this run ended. Run it again.",
    "bad_span": (
        "The end of the run, or of its transient, is NaN, infinite, or lies before its start, or "
        "an observer's window is longer than the run. Give finite, increasing times, because dry "
        "friction cannot be integrated backward in time, and a window that fits."
    ),
    "pending": (
        "This run has not been computed yet: the sweep of this store is under way or was "
        "interrupted. Repeat the call, or use `jaxchain resume`."
    ),
    "forces_not_unique": (
        "Contacts that stick hold the same displacements twice, so that the forces of each do not "
        "follow from the equations: rigid bodies have many solutions there. Leave out one of the "
        "contacts, or put a spring or a displacement between them."
    ),
    "bounces_accumulate": (
        "A mass bounces on a stop infinitely often in a finite time and comes to rest there: the "
        "event-driven run ends. Use an elastic stop, a `local_force` that grows beyond the "
        "gap, or a restitution nearer to 1."
    ),
}
WELL = ("successful", "quiet", "steady")
