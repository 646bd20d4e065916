"""The speed of this machine: the performance promises as a table.

- `command`: `jaxchain bench`
- `compiled_step`: one Rosenbrock step in C, to see how far the step is from it
- `equal_error`: solvers at equal error, each with its best tolerance
- `machine`: what the table was measured on
- `page`: the table as Markdown
- `peers`: LSODA and CVODE with compiled right side and Jacobian
- `peers_heyoka`: heyoka with events for true dry friction
- `rows_ensembles`: rows about many lanes
- `rows_gpu`: the row about a GPU
- `rows_heyoka`: rows about true dry friction against heyoka
- `rows_size`: the row about long chains
- `rows_solvers`: rows about one integration
- `rows_steps`: rows about what a step is made of, and what an import costs
- `rows_sweep`: the row about what a sweep adds to its runs
- `timing`: measuring in turn, and tables of it
"""
