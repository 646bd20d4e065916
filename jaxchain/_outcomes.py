"""How a run may end, by name, with advice.  Nothing here needs JAX."""

# In the order of the codes in results.
ADVICE = {
    "successful": "",
    "quiet": (
        "Stopped early: every mass rests in steady sliding, which attracts, and nothing that is "
        "observed can change any more."
    ),
    "steady": (
        "Stopped early: everything that is observed repeats itself within the tolerance asked."
    ),
    "max_steps_reached": (
        "The run used up its steps before it reached its end. Allow more (`max_steps`), loosen "
        "`rtol`, or use a larger regularization width."
    ),
    "step_too_small": (
        "The step size fell below what the time can resolve: the state ran away or became NaN, or "
        "the regularization width is too small for these tolerances. Check the parameters, "
        "a negative damping ratio above all, and loosen `rtol` or enlarge the width."
    ),
    "untrusted_linear_solve": (
        "The truncated linear solve of the structured solver is not proven accurate for this step "
        "and coupling. Use the exact solve (`Rodas4(sweeps=None)`), a smaller constant step, or "
        "an adaptive controller."
    ),
    "nonfinite": (
        "The state is NaN or infinite. Check the initial state and the parameters of this lane; "
        "a negative damping ratio lets the vibration grow without bound."
    ),
    "solver_failed": (
        "The diffrax solver reported a failure. Loosen `rtol` or choose another solver."
    ),
    "events_accumulate": (
        "Sticking and sliding alternate without time going on. Please report the parameters and "
        "the state; a change of either in the last digits may help."
    ),
    "interrupted": "The ensemble was interrupted before this lane ended. Run it again.",
    "bad_span": (
        "The end of the run, or of its transient, is NaN, infinite, or lies before its start, or "
        "an observer's window is longer than the run. Give finite times in their order, as dry "
        "friction cannot be integrated backward in time, and a window that fits."
    ),
    "pending": (
        "This lane has not run yet: the sweep that its store is for is under way, or was cut off. "
        "Make the same call again, or `jaxchain resume` it."
    ),
}
WELL = ("successful", "quiet", "steady")
