# The library `ssrvlad`: the core, which needs a C++17 compiler only.

find_package(Threads REQUIRED)
set(CORE "${CMAKE_CURRENT_LIST_DIR}/../../../ssrvlad_torch/native")
file(GLOB CORE_SOURCES CONFIGURE_DEPENDS "${CORE}/*.cpp")
file(GLOB CORE_HEADERS "${CORE}/*.h")
add_library(ssrvlad ${CORE_SOURCES})
target_compile_features(ssrvlad PUBLIC cxx_std_17)
if(NOT MSVC)
  target_compile_options(ssrvlad PRIVATE -ffp-contract=off)  # the same sums on every processor
endif()
target_include_directories(ssrvlad PUBLIC "$<BUILD_INTERFACE:${CORE}>" "$<INSTALL_INTERFACE:include>")
target_link_libraries(ssrvlad PRIVATE Threads::Threads)
