"""How the tables of the history came about, step by step; Alembic runs what a database does not have yet."""
