include(CMakeFindDependencyMacro)
find_dependency(ZLIB)
include("${CMAKE_CURRENT_LIST_DIR}/onnxruntime.cmake")
include("${CMAKE_CURRENT_LIST_DIR}/ssrvlad_placeTargets.cmake")
