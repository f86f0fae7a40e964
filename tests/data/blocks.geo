SetFactory("OpenCASCADE");     // lengths in mm
Box(1) = {0, 0, 0, 20, 20, 10};
Box(2) = {5, 5, 10, 10, 10, 10};
Physical Volume("lower") = {1};
Physical Volume("upper") = {2};
Physical Surface("base") = {5};    // sides of a box: x, y and z, each lower then upper
Physical Surface("table") = {6};
Physical Surface("foot") = {11};
Physical Surface("top") = {12};
MeshSize{ PointsOf{ Volume{1, 2}; } } = 2.5;
