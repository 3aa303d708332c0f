// CGAL's SRE_ARAP: cgal_sr_arap MESH.off HANDLES ALPHA ITERATIONS prints the deformed vertices.
// A line of HANDLES is "index x y z".
#include <CGAL/Simple_cartesian.h>
#include <CGAL/Surface_mesh.h>
#include <CGAL/Surface_mesh_deformation.h>

#include <fstream>
#include <iomanip>
#include <iostream>
#include <string>
#include <utility>
#include <vector>

using Point = CGAL::Simple_cartesian<double>::Point_3;
using Mesh = CGAL::Surface_mesh<Point>;
using Deformation =
    CGAL::Surface_mesh_deformation<Mesh, CGAL::Default, CGAL::Default, CGAL::SRE_ARAP>;

int main(int, char** argument) {
  Mesh mesh;
  std::ifstream(argument[1]) >> mesh;
  Deformation deformation(mesh);
  deformation.insert_roi_vertices(vertices(mesh).begin(), vertices(mesh).end());
  std::vector<std::pair<Mesh::Vertex_index, Point>> targets;
  std::ifstream handles(argument[2]);
  unsigned index;
  double x, y, z;
  while (handles >> index >> x >> y >> z) {
    targets.emplace_back(Mesh::Vertex_index(index), Point(x, y, z));
    deformation.insert_control_vertex(targets.back().first);
  }
  deformation.set_sre_arap_alpha(std::stod(argument[3]));
  if (!deformation.preprocess()) return 1;
  for (const auto& target : targets)
    deformation.set_target_position(target.first, target.second);
  deformation.deform(std::stoi(argument[4]), 0.0);
  for (auto vertex : vertices(mesh))
    std::cout << std::setprecision(17) << mesh.point(vertex) << "\n";
}
