"""The paper's tables on the authors' data set: layout of its folders, measurements, our methods, and the report."""
