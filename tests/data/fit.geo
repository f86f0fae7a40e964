// A quarter of two rings; the inner one is 0.01 mm too large. Lengths in mm.
a = 20; b = 50; c = 100; d = 0.01;
Point(1) = {0, 0, 0};
Point(2) = {a, 0, 0};  Point(3) = {b + d, 0, 0};
Point(4) = {0, b + d, 0};  Point(5) = {0, a, 0};
Line(1) = {2, 3};  Circle(2) = {3, 1, 4};  Line(3) = {4, 5};  Circle(4) = {5, 1, 2};
Curve Loop(1) = {1, 2, 3, 4};  Plane Surface(1) = {1};
Point(6) = {b, 0, 0};  Point(7) = {c, 0, 0};
Point(8) = {0, c, 0};  Point(9) = {0, b, 0};
Line(5) = {6, 7};  Circle(6) = {7, 1, 8};  Line(7) = {8, 9};  Circle(8) = {9, 1, 6};
Curve Loop(2) = {5, 6, 7, 8};  Plane Surface(2) = {2};
Transfinite Curve {2, 4, 6, 8} = 17;  Transfinite Curve {1, 3} = 7;
Transfinite Curve {5, 7} = 8;
Transfinite Surface {1, 2};  Recombine Surface {1, 2};
Physical Surface("shaft") = {1};  Physical Surface("hub") = {2};
Physical Curve("fit") = {2};  Physical Curve("bore") = {8};
Physical Curve("along x") = {1, 5};  Physical Curve("along y") = {3, 7};
