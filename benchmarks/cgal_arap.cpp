// CGAL's ARAP: cgal_arap MESH.off HANDLES [ALPHA], with smooth rotations (SRE_ARAP) where ALPHA is
// given. A line of HANDLES is "index x y z". Says how many seconds the preparation took. Then it
// obeys the lines of its input: "deform N" does N iterations, "reset" goes back to the rest shape,
// "print" prints the vertices; each ends with a line "done".
#include <CGAL/Simple_cartesian.h>
#include <CGAL/Surface_mesh.h>
#include <CGAL/Surface_mesh_deformation.h>

#include <chrono>
#include <fstream>
#include <iomanip>
#include <iostream>
#include <string>
#include <utility>
#include <vector>

using Point = CGAL::Simple_cartesian<double>::Point_3;
using Mesh = CGAL::Surface_mesh<Point>;

template <CGAL::Deformation_algorithm_tag METHOD>
int serve(int arguments, char** argument) {
  using Deformation =
      CGAL::Surface_mesh_deformation<Mesh, CGAL::Default, CGAL::Default, METHOD>;
  Mesh mesh;
  std::ifstream(argument[1]) >> mesh;
  std::vector<std::pair<Mesh::Vertex_index, Point>> targets;
  std::ifstream handles(argument[2]);
  unsigned index;
  double x, y, z;
  while (handles >> index >> x >> y >> z)
    targets.emplace_back(Mesh::Vertex_index(index), Point(x, y, z));

  const auto began = std::chrono::steady_clock::now();
  Deformation deformation(mesh);
  deformation.insert_roi_vertices(vertices(mesh).begin(), vertices(mesh).end());
  for (const auto& target : targets) deformation.insert_control_vertex(target.first);
  if (arguments > 3) deformation.set_sre_arap_alpha(std::stod(argument[3]));
  if (!deformation.preprocess()) return 1;
  const std::chrono::duration<double> seconds = std::chrono::steady_clock::now() - began;
  std::cout << seconds.count() << std::endl;

  const auto move_handles = [&] {
    for (const auto& target : targets)
      deformation.set_target_position(target.first, target.second);
  };
  move_handles();
  std::string command;
  while (std::cin >> command) {
    if (command == "deform") {
      int iterations;
      std::cin >> iterations;
      deformation.deform(iterations, 0.0);
    } else if (command == "reset") {
      deformation.reset();
      move_handles();
    } else {
      for (auto vertex : vertices(mesh))
        std::cout << std::setprecision(17) << mesh.point(vertex) << "\n";
    }
    std::cout << "done" << std::endl;
  }
  return 0;
}

int main(int arguments, char** argument) {
  return arguments > 3 ? serve<CGAL::SRE_ARAP>(arguments, argument)
                       : serve<CGAL::ORIGINAL_ARAP>(arguments, argument);
}
