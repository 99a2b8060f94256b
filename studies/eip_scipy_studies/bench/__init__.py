"""Error against cost: with functions of a user, with problems of the library, and by other packages."""
