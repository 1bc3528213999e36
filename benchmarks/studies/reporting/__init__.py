"""What a study is: a plan of windows, its records, figures, charts and the page made of them."""
