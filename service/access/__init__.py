"""Who may do what over HTTP: tokens, scopes, TLS, limits, and the audit log of what was done and refused."""
