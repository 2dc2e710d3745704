# The target onnxruntime::onnxruntime, from ORT_ROOT or from a CMake package.

if(DEFINED ENV{ORT_ROOT})
  set(ORT_BUILT_WITH "$ENV{ORT_ROOT}")
endif()
set(ORT_ROOT "${ORT_BUILT_WITH}" CACHE PATH "folder of ONNX Runtime")

if(ORT_ROOT AND NOT TARGET onnxruntime::onnxruntime)
  find_path(ORT_HEADERS onnxruntime_cxx_api.h REQUIRED NO_DEFAULT_PATH
    PATHS "${ORT_ROOT}/include" PATH_SUFFIXES onnxruntime onnxruntime/core/session)
  find_library(ORT_LIBRARY onnxruntime REQUIRED NO_DEFAULT_PATH PATHS "${ORT_ROOT}/lib")
  add_library(onnxruntime::onnxruntime UNKNOWN IMPORTED)
  set_target_properties(onnxruntime::onnxruntime PROPERTIES
    IMPORTED_LOCATION "${ORT_LIBRARY}"
    INTERFACE_INCLUDE_DIRECTORIES "${ORT_HEADERS}")
elseif(NOT TARGET onnxruntime::onnxruntime)
  find_package(onnxruntime REQUIRED)
endif()
