// A steel bracket with a rubber pad under its end. Lengths in mm.
Point(1) = {0, 0, 0};  Point(2) = {10, 0, 0};  Point(3) = {10, 50, 0};
Point(4) = {60, 50, 0};  Point(5) = {80, 50, 0};  Point(6) = {80, 60, 0};
Point(7) = {0, 60, 0};  Point(8) = {60, 40, 0};  Point(9) = {80, 40, 0};
Line(1) = {1, 2};  Line(2) = {2, 3};  Line(3) = {3, 4};  Line(4) = {4, 5};
Line(5) = {5, 6};  Line(6) = {6, 7};  Line(7) = {7, 1};
Line(8) = {8, 9};  Line(9) = {9, 5};  Line(10) = {4, 8};
Curve Loop(1) = {1, 2, 3, 4, 5, 6, 7};  Plane Surface(1) = {1};
Curve Loop(2) = {8, 9, -4, 10};  Plane Surface(2) = {2};   // line 4 is common
Mesh.MeshSizeMax = 4;  Mesh.RecombineAll = 1;
Physical Surface("steel") = {1};  Physical Surface("rubber") = {2};
Physical Curve("wall") = {7};  Physical Curve("top") = {6};
Physical Curve("sole") = {8};
