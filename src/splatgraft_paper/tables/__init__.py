"""The paper's tables on the authors' data set: what its folders hold, what is measured, what is run, the tables."""
